"""A model from scans in correspondence (section 3.1), and how good it is."""

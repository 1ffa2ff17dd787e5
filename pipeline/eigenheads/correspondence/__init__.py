"""Scans in correspondence (section 3.2): the reference warped to the landmarks, then drawn onto each scan."""

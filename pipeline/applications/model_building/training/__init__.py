"""Trains a model on scans in correspondence (section 3.1), and measures how good it is."""

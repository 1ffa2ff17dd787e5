"""Trains a head model on scans in correspondence (the paper's section 3.1), and measures its quality."""

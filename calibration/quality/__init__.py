"""Judges a calibration: which corners are wrong, and what the operator is told."""

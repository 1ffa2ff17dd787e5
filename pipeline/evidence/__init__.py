"""Measures a finished head and judges it by camera, by length and by plausibility."""

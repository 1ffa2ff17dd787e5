"""Measures a finished head and judges it: by camera, by length, by plausibility."""

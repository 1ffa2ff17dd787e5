"""Measures a finished head: errors in each camera, anthropometric distances, expression and plausibility."""

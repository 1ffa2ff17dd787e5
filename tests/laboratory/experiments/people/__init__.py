"""Measures pose, face, lids and expressions of living people with few, many and narrow-angled cameras."""

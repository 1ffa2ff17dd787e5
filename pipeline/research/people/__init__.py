"""Measures pose, face, lids and expressions of people before few, many and narrow cameras."""

"""Measures takes: one person in several moments."""

"""Repeats the paper's experiments (section 5) and runs this project's own; each prints its figures. Not part of a
wheel."""

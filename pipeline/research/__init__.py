"""Repeats the paper's experiments (section 5) and runs ours; each prints its figures. Not part of a wheel."""

"""Repeats what the paper measured (tables 1 to 3, convergence, cameras), and measures the same of this project's
solver."""

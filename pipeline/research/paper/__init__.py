"""Repeats what the paper measured (tables 1 to 3, convergence, cameras), and asks the same of our solver."""

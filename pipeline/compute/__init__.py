"""How loops run, compiled ahead and shared out over threads, and the arrays that a model alone decides.

Knows nothing of heads or images; every room may use it.
"""

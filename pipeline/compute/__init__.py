"""How loops run: compiled and kept by content, shared out over threads, and the arrays that a model alone decides.

Knows nothing of heads or images; every room may use it.
"""

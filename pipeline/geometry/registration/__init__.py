"""Registers surfaces to each other: by rigid motions and similarities, with or without shape coefficients or a search
from many starts (``rigid``), and by smooth non-rigid deformation (``nonrigid``). Lengths are mm.

The caller defines the matches, their weights, and when a result is refused.
"""

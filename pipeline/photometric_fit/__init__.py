"""Fits the head to what photographs show inside the outline.

Enters: a solved contour problem and the photographs. Leaves: the same problem with a finer basis and with observations
of the surface, solved again. The paper leaves this open.
"""

"""Fits the head to the photographs inside the outline.

In: a solved contour problem and the photographs. Out: the same problem with a finer basis and with observations of the
surface, solved again. The paper does not do this.
"""

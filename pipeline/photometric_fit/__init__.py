"""Fits the head to the photographs inside the outline, which the paper does not do.

The input is a solved contour problem and the photographs. The output is the same problem with more modes and with
observations of the surface, solved again."""

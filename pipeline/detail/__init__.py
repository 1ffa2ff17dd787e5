"""Deforms the fitted head to the surface that dense matching measured (level ``fine``), lids and ears included.

In: the fit, the depth of every view, and the appearance of the eyes in the photographs. Out: vertices of the model's
full level (world, mm) and their standard deviation.
"""

"""Deforms the fitted head to the surface that dense matching measured (level ``fine``), lids and ears included.

Enters: the fit, depth of every view, and what the photographs show between the lids. Leaves: vertices of the model's
full level (world, mm) and their standard deviation.
"""

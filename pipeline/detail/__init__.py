"""Deforms the fitted head to the dense surface (level ``fine``), lids and ears included.

Enters: the fit, depth of every view, what shows of the eyes. Leaves: vertices of the model's full level (world, mm) and
their deviation.
"""

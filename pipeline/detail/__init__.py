"""Deforms the fitted head to the surface from dense stereo (detail level ``fine``), lids and ears included.

The modules take the fit, the depth map of every view, and the photographs of the eyes. The modules return the vertices
of the model's full mesh (world frame, mm) and their standard deviation.
"""

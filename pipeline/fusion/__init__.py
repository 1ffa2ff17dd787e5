"""Fuses depth maps to one closed surface: computes a signed distance on a sparse grid, extracts a mesh by surface nets,
and moves its vertices to the depth maps.

The inputs are depth maps, silhouettes and, for unseen regions, the fitted head. The package's result is a watertight
mesh in the world frame (mm), with a part label and a standard deviation for each vertex.
"""

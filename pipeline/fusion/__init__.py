"""Fuses depth maps to one closed surface: a signed distance on a sparse grid, its surface net, and its vertices refined
by the views.

Enters: depth maps, silhouettes and, for what no camera sees, the fitted head. Leaves: a watertight mesh in the world
frame (mm), with the part and the standard deviation of each vertex.
"""

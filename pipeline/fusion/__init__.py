"""Fuses depth maps to one closed surface: a signed distance on a sparse grid, its net, its vertices moved by the views.

Enters: depth maps, silhouettes and, where nobody looks, the fitted head. Leaves: a watertight mesh in the world frame
(mm) with parts and deviation a vertex.
"""

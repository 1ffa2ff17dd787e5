"""Colours a fitted surface (section 4.5).

In: a mesh in the world frame, photographs, silhouettes, the rig. Out: a colour for each vertex, or an atlas.
"""

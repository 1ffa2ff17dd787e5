"""Colours a fitted surface (section 4.5).

Enters: a mesh in the world frame, photographs, silhouettes, the rig. Leaves: a colour a vertex, or an atlas.
"""

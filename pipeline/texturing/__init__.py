"""Colours a fitted surface (the paper's section 4.5).

The modules compute a colour for each vertex, or a texture image, from photographs, silhouettes and the rig.
"""

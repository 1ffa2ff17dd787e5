"""Measures the depth of the subject in every view from the photographs.

Enters: photographs, silhouettes, the rig and the fitted head. Leaves: a ``DepthMap`` a view (mm, normals, deviation).
"""

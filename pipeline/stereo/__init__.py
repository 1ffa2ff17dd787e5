"""Measures the depth of the subject in every view from the photographs.

In: photographs, silhouettes, the rig and the fitted head. Out: a ``DepthMap`` for each view (mm, normals, deviation).
"""

"""Computes a depth map for every view by matching the photographs (multi-view stereo).

The inputs are photographs, silhouettes, the rig and the fitted head. A ``DepthMap`` holds depths (mm), normals and
standard deviations.
"""

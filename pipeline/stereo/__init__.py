"""Computes a depth map for every view by matching the photographs (multi-view stereo).

A ``DepthMap`` holds depths (mm), normals and standard deviations at the pixels of a view.
"""

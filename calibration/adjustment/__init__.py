"""Corners to cameras: lenses, pose graph, bundle adjustment and its gauge, time offsets, world frame."""

"""Estimates cameras from corners of a board: lenses, pose graph, bundle adjustment and its gauge, time offsets, world
frame.

In: detected corners (px) by camera and shot. Out: a rig (mm) with covariances. Method: Triggs et al. (2000)."""

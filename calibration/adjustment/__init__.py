"""Estimates cameras from corners of a board: lenses, pose graph, bundle adjustment and its gauge, time offsets, world
frame.

Enters: detected corners (px) by camera and shot. Leaves: a rig (mm) with covariances. Method: Triggs et al. (2000)."""

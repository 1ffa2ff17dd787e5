"""Estimates lenses, camera poses and time offsets from the detected corners of a calibration board.

The input is corners (px) by camera and shot. The output is a rig (mm) with covariances, from a bundle adjustment
(Triggs et al., 2000)."""

"""Estimates lenses, camera poses and time offsets from the detected corners of a calibration board.

The input of the adjustment is corners (px) by camera and shot. The output of the adjustment is a rig (mm) with
covariances, from a bundle adjustment (Triggs et al., 2000)."""

"""Decides which views of a capture are used. Finds exchanged pictures, cameras that moved, the calibration of another
rig, and outlines of the wrong size.

The checks compare the silhouettes with the calibrated cameras. The checks return the consistent views, repaired where
the repair is certain, and warnings.
"""

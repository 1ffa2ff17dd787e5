"""Decides which views a job may use. Finds exchanged pictures, cameras that moved, a calibration of another rig, and
outlines too large or small for a head.

Enters: silhouettes and the rig. Leaves: the views that agree, corrected where the correction is certain, and warnings.
"""

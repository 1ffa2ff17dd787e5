"""Decides which views a job may use. Finds exchanged pictures, cameras that moved, a calibration of another rig, and
outlines too large or too small for a head.

In: silhouettes and the rig. Out: the views that agree, corrected where the correction is certain, and warnings.
"""

"""Finds faces of living people in photographs: where a face is in each picture, dense landmarks on it, and their
uncertainty.

Enters: photographs and the rig. Leaves: a ``detection.FaceDetection`` for each face in each picture, and over all
pictures ``matching.MatchedFaces``: which of them are the subject's, and the landmarks in the world (mm) with
covariances.
"""

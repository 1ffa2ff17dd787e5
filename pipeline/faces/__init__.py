"""Finds living people's faces in photographs: the position of each face, dense landmarks on it, and their uncertainty.

In: photographs and the rig. Out: a ``detection.FaceDetection`` for each face in each picture, and one
``matching.MatchedFaces`` for all pictures: which faces are the subject's, and the landmarks in the world (mm) with
covariances.
"""

"""Faces in photographs (living people): where a face is in each picture, dense landmarks on it, and how sure.

Enters: photographs and the rig. Leaves: ``detection.FaceDetection`` a picture, and across pictures
``matching.MatchedFaces``: which of them are the subject's, and the landmarks in the world (mm) with covariances.
"""

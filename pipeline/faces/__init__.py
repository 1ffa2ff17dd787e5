"""Finds faces in photographs: the position of each face, dense landmarks on it, and their uncertainty.

The modules take photographs and the rig. The modules return a ``detection.FaceDetection`` for each face in each
picture, and one ``matching.MatchedFaces`` for all pictures. ``MatchedFaces`` holds the subject's faces and their
landmarks in the world frame (mm) with covariances.
"""

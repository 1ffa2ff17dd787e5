"""Finds the subject in photographs without clean plates (pictures of the empty studio) and masks. The subject is the
object to which all cameras are directed.

The module ``decide`` combines colours, a voxel volume, and a background estimated from the pixels around the subject.
"""

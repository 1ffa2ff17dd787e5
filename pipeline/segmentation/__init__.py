"""Finds the subject in every photograph (section 5.4), with clean plates or without.

In: a capture and its rig. Out: a ``Silhouette`` for each camera, with its quality.
"""

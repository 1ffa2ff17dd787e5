"""Finds the subject in every photograph (section 5.4), with clean plates or without.

Enters: a capture and its rig. Leaves: a ``Silhouette`` for each camera, with its quality.
"""

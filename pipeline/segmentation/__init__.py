"""Finds the subject in every photograph (section 5.4), with clean plates or without.

Enters: a capture and its rig. Leaves: a ``Silhouette`` a camera, with its quality.
"""

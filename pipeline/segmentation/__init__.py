"""Finds the subject's silhouette in every photograph (the paper's section 5.4), with or without clean plates (pictures
of the empty studio).

A capture and its rig give a ``Silhouette`` with its quality for each camera.
"""

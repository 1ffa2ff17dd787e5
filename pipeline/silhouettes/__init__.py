"""Photographs and clean plates to silhouettes (section 5.4).

Enters: a capture and its rig. Leaves: a ``Silhouette`` a camera, with its quality.
"""

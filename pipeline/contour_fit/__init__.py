"""Fits shape, pose and cameras to the outlines (section 4).

Enters: a head model, ``world_from_head``, silhouettes, the rig. Leaves: a ``Fit`` (coefficients, pose, covariance). The
paper's own solver is ``pipeline/simplex``.
"""

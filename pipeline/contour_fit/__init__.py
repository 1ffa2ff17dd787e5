"""Fits shape, pose and cameras to the outlines (section 4).

In: a head model, ``world_from_head``, silhouettes, the rig. Out: a ``Fit`` (coefficients, pose, covariance). The
paper's own solver is ``pipeline/simplex``.
"""

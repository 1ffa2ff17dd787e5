"""Fits the head's shape, its pose and the cameras to the outlines in the photographs (the paper's section 4).

The solver starts from a head model, the pose ``world_from_head``, silhouettes and the rig. The solver returns a ``Fit``
(coefficients, pose, covariance). The paper's own solver is in ``pipeline/simplex``.
"""

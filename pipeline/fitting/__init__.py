"""The shape from silhouettes and photographs (section 4).

Enters: a head model, ``world_from_head``, silhouettes, the rig. Leaves: a ``Fit`` (coefficients, pose, covariance). The
contour solver is the default; ``simplex`` is the paper's.
"""

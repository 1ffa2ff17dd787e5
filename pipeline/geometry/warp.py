"""Landmark warps by radial basis functions (section 3.2, step 3: scattered-data interpolation).

The kernel is the distance itself, which minimises bending in three dimensions (F. Bookstein's thin plate in 3-D;
Carr et al. 2001, *Reconstruction and Representation of 3D Objects with Radial Basis Functions*, section 3), with a
linear polynomial so that affine motions are exact everywhere.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist


def landmark_warp(
    source: Float[np.ndarray, "L 3"],
    target: Float[np.ndarray, "L 3"],
    points: Float[np.ndarray, "N 3"],
    *,
    smoothing: float = 0.0,
) -> Float[np.ndarray, "N 3"]:
    """Moves points by the smooth map that takes each source landmark to its target. If ``smoothing`` (mm) is above 0,
    landmarks may miss their targets in exchange for less bending. At least 4 landmarks that are not on a plane are
    needed; else numpy.linalg.LinAlgError is raised."""
    count = len(source)
    affine = np.concatenate([np.ones((count, 1)), source], 1)
    system = np.zeros((count + 4, count + 4))
    system[:count, :count] = cdist(source, source) - smoothing * np.eye(count)  # this kernel is negative definite
    system[:count, count:], system[count:, :count] = affine, affine.T
    coefficients = np.linalg.solve(system, np.concatenate([target, np.zeros((4, 3))]))
    return cdist(points, source) @ coefficients[:count] + coefficients[count] + points @ coefficients[count + 1 :]

"""Means of values at points over what lies around each."""

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float
from scipy.spatial import KDTree


def means_within(points: Float[np.ndarray, "n 3"], radius_mm: float) -> sparse.csr_array:
    """Returns the sparse matrix that maps values at the points to their means around each point, itself included."""
    pairs, itself = KDTree(points).query_pairs(radius_mm, output_type="ndarray"), np.arange(len(points))
    rows, columns = np.r_[pairs[:, 0], pairs[:, 1], itself], np.r_[pairs[:, 1], pairs[:, 0], itself]
    share = 1.0 / np.bincount(rows, minlength=len(points))
    return sparse.csr_array((share[rows], (rows, columns)), shape=(len(points), len(points)))

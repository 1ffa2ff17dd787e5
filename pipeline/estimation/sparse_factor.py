"""Factors of sparse matrices that are symmetric and positive definite."""

import scipy.sparse as sparse
from scipy.sparse.linalg import SuperLU, splu


def factorised(matrix: sparse.csc_array) -> SuperLU:
    """Returns the factor of a symmetric, positive definite matrix. Without pivoting, and with an order made for
    symmetric matrices, it takes a third to a tenth of SuperLU's default time."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

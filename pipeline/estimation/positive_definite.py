"""Inverses of symmetric positive definite matrices by their Cholesky factor: half of the general inverse's work for the
whole, a third for the diagonal. Both raise LinAlgError where a matrix is not definite."""

import numpy as np
import scipy.linalg
from jaxtyping import Float


def inverse(matrix: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """Returns M^-1, exactly symmetric."""
    root = _root(matrix)
    (invert,) = scipy.linalg.get_lapack_funcs(("potri",), (root,))
    found, fault = invert(root, lower=1)
    assert fault == 0, f"potri: {fault}"
    return np.tril(found) + np.tril(found, -1).T


def inverse_diagonal(matrix: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " p"]:
    """Returns the diagonal of M^-1: with M = L L^T the squares of L^-1, column by column."""
    root = _root(matrix)
    (invert,) = scipy.linalg.get_lapack_funcs(("trtri",), (root,))
    found, fault = invert(root, lower=1)
    assert fault == 0, f"trtri: {fault}"
    return np.einsum("ij,ij->j", found, found)


def _root(matrix: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """Returns the lower Cholesky factor L, with zeros above its diagonal."""
    return scipy.linalg.cholesky(matrix, lower=True, check_finite=False)

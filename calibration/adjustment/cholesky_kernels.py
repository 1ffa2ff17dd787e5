"""Compiled loops of ``calibration.adjustment.cholesky``."""

import numpy as np

from pipeline.compute.jit import njit


@njit(cache=True)
def factor_lower(a: np.ndarray) -> bool:
    """Computes the Cholesky factor L of a symmetric matrix A = L L^T (n, n), in place: the lower triangle of ``a``
    becomes L, the upper one is neither read nor changed. Returns False, with ``a`` partly overwritten, if A is not
    positive definite."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):  # both rows are contiguous
                total -= a[i, k] * a[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                a[i, i] = np.sqrt(total)
            else:
                a[i, j] = total / a[j, j]
    return True


@njit(cache=True)
def solve_lower(lower: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Solves ``L L^T y = x`` for every column of ``x`` (n, m), in place, where L is the lower triangle of ``lower`` (n,
    n). Returns ``x``, which then holds y."""
    n, m = x.shape
    for i in range(n):
        for k in range(i):
            for c in range(m):
                x[i, c] -= lower[i, k] * x[k, c]
        for c in range(m):
            x[i, c] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for c in range(m):
            x[i, c] /= lower[i, i]
        for k in range(i):
            for c in range(m):
                x[k, c] -= lower[i, k] * x[i, c]
    return x

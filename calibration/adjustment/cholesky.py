"""Symmetric positive definite systems of a few hundred unknowns, on one thread.

LAPACK's threaded Cholesky is faster on an idle machine (2 against 12 ms for 345 unknowns), but where other work holds
the cores its threads wait for each other: 600 ms were measured for the same matrix on two busy cores. A calibration
solves some hundred such systems beside a service that works, so steadiness wins.
"""

import numpy as np
from jaxtyping import Float

from pipeline.compiled import njit


class NotPositiveDefinite(np.linalg.LinAlgError):
    """The matrix has no Cholesky factor; the caller raises its damping."""


def factor(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Lower triangular ``L`` with ``L L^T = matrix``. Raises NotPositiveDefinite."""
    lower = np.ascontiguousarray(np.tril(matrix))
    if not _factor(lower):
        raise NotPositiveDefinite
    return lower


def solve(lower: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """``x`` with ``L L^T x = right``."""
    return _solve(lower, np.ascontiguousarray(right, dtype=float).copy())


def solve_system(matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """``x`` with ``matrix x = right``. Raises NotPositiveDefinite."""
    return solve(factor(matrix), right[:, None])[:, 0]


@njit(cache=True)
def _factor(a: np.ndarray) -> bool:
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
def _solve(lower: np.ndarray, x: np.ndarray) -> np.ndarray:
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

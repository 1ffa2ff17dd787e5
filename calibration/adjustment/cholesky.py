"""Solves symmetric positive definite systems of a few hundred unknowns on one thread.

LAPACK's threaded Cholesky is faster on an idle machine (2 against 12 ms for 345 unknowns). But its threads wait for
each other where other work occupies the cores: 600 ms were measured for the same matrix on two busy cores. A
calibration solves some hundred such systems beside a running service, so the steady time is preferred."""

import numpy as np
from jaxtyping import Float

from calibration.adjustment.cholesky_kernels import factor_lower, solve_lower


class NotPositiveDefinite(np.linalg.LinAlgError):
    """Reports a matrix without a Cholesky factor; the solver then raises its damping."""


def factor(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Returns the lower triangular ``L`` with ``L L^T = matrix``. Raises NotPositiveDefinite."""
    lower = np.ascontiguousarray(np.tril(matrix))
    if not factor_lower(lower):
        raise NotPositiveDefinite
    return lower


def solve(lower: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Returns x with ``L L^T x = right``, where ``lower`` is L."""
    return solve_lower(lower, np.ascontiguousarray(right, dtype=float).copy())


def solve_system(matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns x with ``matrix x = right``. Raises NotPositiveDefinite."""
    return solve(factor(matrix), right[:, None])[:, 0]

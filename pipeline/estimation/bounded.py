"""The minimum of a quadratic form with bounds on a few of its unknowns."""

import numpy as np
import scipy.linalg
from jaxtyping import Float


def least_within(
    matrix: Float[np.ndarray, "p p"],
    gradient: Float[np.ndarray, " p"],
    lower: Float[np.ndarray, " p"],
    upper: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """The x that minimises ``x^T M x / 2 + g^T x`` with ``lower <= x <= upper``, M symmetric and positive definite.

    The unknowns without a bound are eliminated (Schur's complement); what is left is least squares with bounds, solved
    by an active set (Stark and Parker 1995, *Bounded-variable least-squares*).
    """
    from scipy.optimize import lsq_linear  # 0.4 s to load, which a model without expressions need not wait for

    tied = np.isfinite(lower) | np.isfinite(upper)
    free = ~tied
    right = np.column_stack([matrix[np.ix_(free, tied)], gradient[free]])
    factor = scipy.linalg.cho_factor(matrix[np.ix_(free, free)], check_finite=False)
    solved = scipy.linalg.cho_solve(factor, right, check_finite=False)
    across = matrix[np.ix_(tied, free)]
    reduced = matrix[np.ix_(tied, tied)] - across @ solved[:, :-1]
    slope = gradient[tied] - across @ solved[:, -1]
    root = np.linalg.cholesky(0.5 * (reduced + reduced.T))
    target = -scipy.linalg.solve_triangular(root, slope, lower=True)
    found = lsq_linear(root.T, target, (lower[tied], upper[tied]), method="bvls")
    step = np.empty(len(gradient))
    step[tied] = np.clip(found.x, lower[tied], upper[tied])
    step[free] = -solved[:, -1] - solved[:, :-1] @ step[tied]
    return step

"""Minimises a quadratic form with bounds on a few of the unknowns."""

import numpy as np
import scipy.linalg
from jaxtyping import Float

PATIENCE = 10  # exchanges of whole blocks without fewer violations, before one unknown at a time is exchanged
ROUNDING = 1e-12  # of the width between the bounds, or of the largest slope: nothing is violated by less
MAX_EXCHANGES = 1000


def least_within(
    matrix: Float[np.ndarray, "p p"],
    gradient: Float[np.ndarray, " p"],
    lower: Float[np.ndarray, " p"],
    upper: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """Returns the x that minimises ``x^T M x / 2 + g^T x`` subject to ``lower <= x <= upper``, where ``matrix`` M is
    symmetric and positive definite and ``gradient`` is g.

    Bounds may be infinite. The unbounded unknowns are eliminated first, so that only the few bounded unknowns need a
    search. If the unbounded unknowns come first, the last corner of M's Cholesky factor is the factor of their Schur
    complement."""
    tied = np.isfinite(lower) | np.isfinite(upper)
    order = np.concatenate([np.flatnonzero(~tied), np.flatnonzero(tied)])
    first = len(order) - int(np.count_nonzero(tied))
    free, bound = order[:first], order[first:]
    root = scipy.linalg.cholesky(matrix[np.ix_(order, order)], lower=True, check_finite=False)
    pulled = scipy.linalg.solve_triangular(root, gradient[order], lower=True, check_finite=False)
    corner, across = root[first:, first:], root[first:, :first]
    step = np.empty(len(gradient))
    step[bound] = _least_in_box(corner @ corner.T, corner @ pulled[first:], lower[bound], upper[bound])
    left = pulled[:first] + step[bound] @ across
    step[free] = -scipy.linalg.solve_triangular(root[:first, :first], left, lower=True, trans=1, check_finite=False)
    return step


def _least_in_box(
    matrix: Float[np.ndarray, "k k"],
    gradient: Float[np.ndarray, " k"],
    lower: Float[np.ndarray, " k"],
    upper: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """Minimises the quadratic form of ``least_within`` if every unknown has a bound, by block principal pivoting
    (Judice and Pires 1994, *A block principal pivoting algorithm for large-scale strictly monotone linear
    complementarity problems*).

    Each unknown is either free or at one of its bounds. All unknowns that violate their optimality conditions change
    together; if this makes no progress, only the last of these unknowns changes (Murty's rule, which always
    terminates)."""
    side, fewest, patience = np.zeros(len(gradient), int), len(gradient) + 1, PATIENCE
    slack = ROUNDING * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    place = np.zeros(len(gradient))
    for _ in range(MAX_EXCHANGES):
        place = np.where(side < 0, lower, np.where(side > 0, upper, 0.0))
        free = np.flatnonzero(side == 0)
        if len(free):
            inside, pull = matrix[np.ix_(free, free)], gradient[free] + matrix[free] @ place
            place[free] = -scipy.linalg.cho_solve(scipy.linalg.cho_factor(inside, check_finite=False), pull)
        slope = matrix @ place + gradient
        inwards = side * slope > ROUNDING * np.abs(gradient).max()
        wanted = np.where(side == 0, (place > upper + slack) * 1 - (place < lower - slack), np.where(inwards, 0, side))
        wrong = np.flatnonzero(wanted != side)
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), PATIENCE
        elif patience:
            patience -= 1
        else:
            wrong = wrong[-1:]
        side[wrong] = wanted[wrong]
    return np.clip(place, lower, upper)

"""Which part of a face is its expression, and which its shape: the evidence of all that is left of a fit.

A basis of smooth deformations follows a smile as willingly as the shape that makes one. How far a head needs it is
seen where it is seen: the variance of each group of modes (eigenheads, kernel, fine kernel) is estimated from the very
fit (MacKay 1992, as in ``posterior``), and where a head hardly strays from its population, a smile is worth a smile.
Weights keep their prior and their bounds. The problem is the last one's quadratic: nothing is looked at again, and the
surface hardly moves. A neutral head is left as it is.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.contour_fit.contour import ContourSolution, normal_equations
from pipeline.contour_fit.head_problem import apply_step, weight_bounds
from pipeline.contour_fit.prior_term import weight_slope
from pipeline.estimation.bounded import least_within
from pipeline.estimation.positive_definite import inverse_diagonal

ROUNDS = 6
NEUTRAL = 0.2  # sum of weights below which a head makes no face: neutral ones have 0 to 0.13 (experiments expressions)
VARIANCE_RANGE = (0.02, 4.0)


def with_expression_evidence(solved: ContourSolution, eigenheads: int) -> ContourSolution:
    """Returns the solution re-estimated with a prior variance for each group of modes; a neutral face is returned
    unchanged.

    Args:
        solved: with all modes; its model's ``posed`` says which are expressions.
        eigenheads: how many of the modes are a population's.
    """
    posed, state = solved.problem.model.posed, solved.state
    if not makes_face(state.coefficients, posed):
        return solved
    equations = normal_equations(solved)
    count, unknowns = len(state.coefficients), len(equations.gradient)
    median, diagonal = solved.problem.settings.expression_median, np.arange(count)
    weights = slice(posed.start, posed.stop)
    matrix, gradient = equations.matrix.copy(), equations.gradient.copy()
    matrix[diagonal, diagonal] -= 1.0  # what the evidence says without the priors
    gradient[:count] -= state.coefficients
    gradient[weights] -= weight_slope(np.maximum(state.coefficients[weights], 0.0), median)
    groups = (diagonal[:eigenheads], diagonal[eigenheads : posed.start], diagonal[posed.stop :])
    variance, now, step = np.ones(count), state.coefficients, np.zeros(unknowns)
    room = weight_bounds(state, posed, unknowns)
    for _ in range(ROUNDS):
        whole, slope = matrix.copy(), gradient.copy()
        whole[diagonal, diagonal] += 1.0 / variance
        slope[:count] += state.coefficients / variance
        slope[weights] += weight_slope(np.maximum(now[weights], 0.0), median)
        step = least_within(whole, slope, *room)
        now = state.coefficients + step[:count]
        covariance = inverse_diagonal(whole)
        for group in groups:
            variance[group] = _variance(now, covariance, variance, group)
    return replace(solved, state=apply_step(state, step, solved.stage))


def makes_face(coefficients: Float[np.ndarray, " m"], posed: range) -> bool:
    """Tells whether the expression weights among the coefficients sum to at least ``NEUTRAL``, so that the face is not
    neutral."""
    return len(posed) > 0 and bool(coefficients[posed.start : posed.stop].sum() >= NEUTRAL)


def _variance(
    coefficients: Float[np.ndarray, " m"],
    covariance: Float[np.ndarray, " p"],
    before: Float[np.ndarray, " m"],
    group: Int[np.ndarray, " k"],
) -> float:
    """Estimates the prior variance of a group of modes: the sum of their squared coefficients, divided by how many of
    them the evidence determines."""
    if not len(group):
        return 1.0
    determined = float(np.clip(1.0 - covariance[group] / before[group], 0.0, 1.0).sum())
    return float(np.clip((coefficients[group] ** 2).sum() / max(determined, 1e-9), *VARIANCE_RANGE))

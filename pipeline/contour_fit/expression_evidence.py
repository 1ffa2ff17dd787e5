"""Separates facial expression from head shape after the fit has converged.

Shape modes can imitate a smile. To limit this imitation, the prior variance of each group of modes (eigenheads, kernel,
fine kernel) is estimated from the fit itself (MacKay 1992, as in ``posterior``). If the head hardly deviates from its
population, the variance is small, and the expression has to explain the smile. Expression weights keep their prior and
their bounds. The surface hardly moves, so the normal equations of the last stage are reused.
"""

import re
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.contour_fit.contour import ContourSolution, normal_equations
from pipeline.contour_fit.head_problem import apply_step, weight_bounds
from pipeline.contour_fit.prior_term import weight_slope
from pipeline.estimation.bounded import least_within
from pipeline.estimation.positive_definite import inverse_diagonal
from pipeline.head_model.model import HeadModel

ROUNDS = 6
NEUTRAL = 0.2  # sum of weights below which a head makes no face: neutral ones have 0 to 0.13 (laboratory's expressions)
VARIANCE_RANGE = (0.02, 4.0)
STRONG = 0.3  # weight above which two opposites contradict each other
OPPOSITE = -0.5  # cosine of two displacements below which they cancel: a pucker and a retraction have -0.8
BOUND = 0.99  # weight that would be larger if it could
LIDS = re.compile("eye(?!brow)")  # names of expressions that move lids or gaze


def solve_expressions(solved: ContourSolution, eigenheads: int) -> ContourSolution:
    """Solves once more for shape and expression, with the prior variance of each group of modes estimated from the fit.
    A neutral face is returned unchanged.

    Args:
        solved: a solution for all modes; ``posed`` of its model says which modes are expressions.
        eigenheads: how many of the modes, the first ones, are eigenheads.
    """
    posed, state = solved.problem.model.posed, solved.state
    if not makes_face(state.coefficients, posed):
        return solved
    equations = normal_equations(solved)
    count, unknowns = len(state.coefficients), len(equations.gradient)
    diagonal = np.arange(count)
    weights = slice(posed.start, posed.stop)
    matrix, gradient = equations.matrix.copy(), equations.gradient.copy()
    matrix[diagonal, diagonal] -= 1.0  # what the evidence says without the priors
    gradient[:count] -= state.coefficients
    gradient[weights] -= weight_slope(np.maximum(state.coefficients[weights], 0.0))
    groups = (diagonal[:eigenheads], diagonal[eigenheads : posed.start], diagonal[posed.stop :])
    variance, now, step = np.ones(count), state.coefficients, np.zeros(unknowns)
    room = weight_bounds(state, solved.problem, unknowns)
    for _ in range(ROUNDS):
        whole, slope = matrix.copy(), gradient.copy()
        whole[diagonal, diagonal] += 1.0 / variance
        slope[:count] += state.coefficients / variance
        slope[weights] += weight_slope(np.maximum(now[weights], 0.0))
        step = least_within(whole, slope, *room)
        now = state.coefficients + step[:count]
        covariance = inverse_diagonal(whole)
        for group in groups:
            variance[group] = estimate_variance(now, covariance, variance, group)
    return replace(solved, state=apply_step(state, step, solved.stage))


def makes_face(coefficients: Float[np.ndarray, " m"], posed: range) -> bool:
    """Returns True if the face has an expression, that is, if the expression weights ``coefficients[posed]`` sum to at
    least ``NEUTRAL``."""
    return len(posed) > 0 and bool(coefficients[posed.start : posed.stop].sum() >= NEUTRAL)


def doubtful_weights(model: HeadModel, coefficients: Float[np.ndarray, " m"]) -> frozenset[int]:
    """Returns the indices of expressions that probably explain noise or an unusual shape. Doubtful expressions are
    pairs of strong opposite expressions, or have a weight at the upper bound. Expressions of the lids are never
    returned, because the lids are measured elsewhere."""
    weights = coefficients[model.posed.start : model.posed.stop]
    found = [np.flatnonzero(weights > BOUND)]
    strong = np.flatnonzero(weights > STRONG)
    shapes = model.expressions.shapes.reshape(len(weights), -1)[strong].astype(float)
    alike = shapes @ shapes.T / np.maximum(np.outer(*2 * (np.linalg.norm(shapes, axis=1),)), 1e-9)
    found.append(strong[(alike < OPPOSITE).any(axis=1)])
    return frozenset(int(row) for row in np.concatenate(found) if not LIDS.match(model.expressions.names[row]))


def estimate_variance(
    coefficients: Float[np.ndarray, " m"],
    covariance: Float[np.ndarray, " p"],
    before: Float[np.ndarray, " m"],
    group: Int[np.ndarray, " k"],
) -> float:
    """Estimates the prior variance of a group of modes: the sum of their squared coefficients, divided by the number of
    coefficients that the observations determine."""
    if not len(group):
        return 1.0
    determined = float(np.clip(1.0 - covariance[group] / before[group], 0.0, 1.0).sum())
    return float(np.clip((coefficients[group] ** 2).sum() / max(determined, 1e-9), *VARIANCE_RANGE))

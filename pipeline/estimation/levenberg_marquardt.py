"""Implements Levenberg-Marquardt for a sum of robust terms, with one damping rule and one stopping rule.

Each step solves ``(M + lambda diag(M)) step = -gradient`` (Marquardt 1963), so steps do not depend on the units of the
unknowns. A step that lowers the cost is taken, and lambda is divided by ten; otherwise lambda is multiplied by a
hundred and the step is computed again. The search ends when the predicted decrease of the cost is below
``Limits.tolerance``. Costs are in squared standard deviations: a predicted decrease of f is a step of sqrt(f) standard
deviations.

If unknowns have bounds, the step is the minimum of the damped quadratic model within the bounds (``bounded``).

Some costs are not smooth, for example because the sample points on a head's rim change as the head moves. The search
may therefore accept a step up to the highest of the last ``Limits.memory`` costs (Grippo, Lampariello and Lucidi 1986);
it always returns the best value."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal

import numpy as np
import scipy.linalg
from jaxtyping import Float

from pipeline.estimation.bounded import least_within
from pipeline.estimation.terms import Linearised, NormalEquations, Problem, Value

MIN_DAMPING = 1e-7  # after accepted steps; relative to the diagonal, Gauss-Newton to seven digits
DAMPING_REFUSED = 1e-2  # at least, after a refused step
MIN_DIAGONAL = 1e-12  # of an undetermined unknown: damping then keeps it constant

Reason = Literal["converged", "no step lowers the cost", "step limit"]
Solve = Callable[[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]], Float[np.ndarray, " p"]]


@dataclass(frozen=True, slots=True)
class Limits:
    """Holds the limits at which a search stops, and its first damping. ``tolerance`` (squared standard deviations) is
    the smallest predicted decrease of the cost for which a step is taken."""

    steps: int = 50
    tolerance: float = 1e-6
    tries: int = 3  # of a step, each with a hundred times the damping
    memory: int = 1  # costs that a step may climb back to; 1: each step lowers the cost
    first_damping: float = 1e-3


@dataclass(frozen=True, slots=True)
class Evidence:
    """Holds why a search ended, the number of evaluations and steps, and the final cost."""

    termination_reason: Reason
    evaluations: int
    steps: int
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Solution(Generic[Value]):
    """Holds the result of a search: the best value, the problem linearised at this value (for computing a covariance),
    and how the search ended."""

    value: Value
    at: Linearised
    evidence: Evidence


def cholesky_solve(matrix: Float[np.ndarray, "p p"], right: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Solves linear equations with a symmetric positive definite matrix. Raises LinAlgError if the matrix is not
    positive definite."""
    # Not ``solve(assume_a="pos")``: its estimate of the condition warns of unknowns with different units.
    return scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix, check_finite=False), right, check_finite=False)


def minimise(
    problem: Problem[Value],
    start: Value,
    limits: Limits,
    *,
    solve: Solve = cholesky_solve,
    least: Callable[..., Float[np.ndarray, " p"]] = least_within,
    at_start: Linearised | None = None,
    watch: Callable[[], None] = lambda: None,
) -> Solution[Value]:
    """Searches for a local minimum of the problem's cost by Levenberg-Marquardt.

    Args:
        problem: terms, number of unknowns, and how a step changes a value.
        start: a value at which all terms are finite.
        limits: when to stop.
        solve: solves a symmetric positive definite system. Where the matrix is not definite it raises LinAlgError; the
            step is then tried again with more damping.
        least: a function like ``least_within``, for steps that reach a bound.
        at_start: the problem linearised at ``start``, if the caller has it already.
        watch: called before every step; an exception that it raises ends the search.
    """
    here = at_start or problem.at(start)
    now = best = _Place(start, here, here.cost)
    recent, damping, evaluations, predicted = [now.cost], limits.first_damping, 1, np.inf

    def ended(reason: Reason) -> Solution[Value]:
        return Solution(best.value, best.at, Evidence(reason, evaluations, len(recent) - 1, best.cost))

    for _ in range(limits.steps):
        watch()
        equations, accepted = problem.equations(now.at), None
        for _ in range(limits.tries):
            step = _damped_step(equations, damping, solve)
            if step is not None:
                predicted = -float(equations.gradient @ step)
                if problem.room is not None:
                    step, predicted = _within(equations, damping, step, problem.room(now.value), least)
                value, evaluations = problem.after(now.value, step), evaluations + 1
                tried = _Place(value, there := problem.at(value), there.cost)
                if tried.cost < max(recent[-limits.memory :]):  # False if the cost is NaN
                    accepted = tried
                    break
                if predicted < limits.tolerance:
                    return ended("converged")
            damping = max(damping * 100.0, DAMPING_REFUSED)
        if accepted is None:
            return ended("no step lowers the cost")
        now, damping = accepted, max(damping * 0.1, MIN_DAMPING)
        recent.append(now.cost)
        if now.cost < best.cost:
            best = now
        if predicted < limits.tolerance:
            return ended("converged")
    return ended("step limit")


@dataclass(frozen=True, slots=True, eq=False)
class _Place(Generic[Value]):
    """Holds a value, the problem linearised at this value, and the cost."""

    value: Value
    at: Linearised
    cost: float


def _damped_step(equations: NormalEquations, damping: float, solve: Solve) -> Float[np.ndarray, " p"] | None:
    """Returns the step that solves the damped normal equations, or None if their matrix is not positive definite."""
    try:
        return -solve(_damped(equations, damping), equations.gradient)
    except np.linalg.LinAlgError:
        return None


def _damped(equations: NormalEquations, damping: float) -> Float[np.ndarray, "p p"]:
    damped = equations.matrix.copy()
    diagonal = np.einsum("ii->i", damped)
    diagonal += damping * (diagonal + MIN_DIAGONAL)
    return damped


def _within(
    equations: NormalEquations,
    damping: float,
    step: Float[np.ndarray, " p"],
    room: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
    least: Callable[..., Float[np.ndarray, " p"]],
) -> tuple[Float[np.ndarray, " p"], float]:
    """Returns the step limited to the bounds ``room``, and the decrease of the cost that the normal equations predict
    for it."""
    if ((step >= room[0]) & (step <= room[1])).all():
        return step, -float(equations.gradient @ step)
    damped = _damped(equations, damping)
    step = least(damped, equations.gradient, *room)
    return step, -float(2.0 * equations.gradient @ step + step @ damped @ step)

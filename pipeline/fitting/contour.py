"""The contour solver: Levenberg-Marquardt on the rim (section 4.4's problem, another cost and another minimiser).

In: the silhouettes' signed distances, a start pose, feature points where there are any. Out: coefficients, pose, camera
corrections, and their covariance (equations.py has the cost and its derivatives). The robust scale shrinks step by
step, which carries the fit over clutter from a start that is 20 px off; while it is coarse, the prior holds the shape.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from jaxtyping import Float

from pipeline.eigenheads.model import HeadModel
from pipeline.fitting.equations import apply_step, evaluate, normal_equations
from pipeline.fitting.fit import Fit
from pipeline.fitting.misfit import is_bare, with_misfit
from pipeline.fitting.problem import FIRST_CORRELATION_PX, POSE, Problem, Stage, State, make_problem, start_state
from pipeline.settings import FittingSettings
from pipeline.silhouette import Silhouette
from rig.geometry import Similarity
from rig.layout import Rig

TRIES = 3  # of a step, each with a hundred times the damping
NON_MONOTONE = 4  # costs that a step may climb back to


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A problem with its solution, from which others may go on."""

    problem: Problem
    state: State
    stage: Stage  # the last one
    evaluations: int
    stopped_because: str
    misfit_mm: Float[np.ndarray, " v0"] | None = None  # of ``Fit``


def fit_contour(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    *,
    features: Mapping[str, Mapping[str, np.ndarray]] | None = None,
    report: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Fit:
    """Fits shape, pose and cameras to the silhouettes that are usable, from a start pose.

    All modes of ``model`` are used: the first ``settings.modes`` first, the rest once those have settled.
    """
    return finish(solve_contour(model, world_from_head, silhouettes, rig, settings, features=features, report=report))


def solve_contour(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    *,
    features: Mapping[str, Mapping[str, np.ndarray]] | None = None,
    report: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Solved:
    """``fit_contour`` without its covariance."""
    problem = make_problem(model, world_from_head, silhouettes, rig, settings, features or {})
    few, span, whole, *rest = schedule(settings, len(model.modes))
    state = start_state(problem, world_from_head)
    state, spent, reason = run_stage(problem, state, few, lambda f: report("fit", 0.2 * f))
    state, used, reason = run_stage(problem, state, span, lambda f: report("fit", 0.2 + 0.2 * f))
    tried, more, _ = run_stage(problem, state, whole, lambda f: report("fit", 0.4 + 0.1 * f))
    spent += used + more
    bare = is_bare(problem, tried, whole, state)
    if bare:
        state, span = tried, whole
    problem = with_misfit(problem, state, span)
    stage = span
    for i, stage in enumerate(rest):
        stage = replace(stage, whole_head=bare)
        state, used, reason = run_stage(
            problem, state, stage, lambda f, i=i: report("fit", 0.5 + 0.5 * (i + f) / len(rest))
        )
        spent += used
        problem = with_misfit(problem, state, stage)
    return Solved(problem, state, stage, spent, reason)


def schedule(settings: FittingSettings, modes: int) -> list[Stage]:
    """Pose and a few modes on a decimated mesh; the eigenheads, from the face's rim; the same from the whole head's,
    kept if the head turns out to be bare; then what modes the model has beyond the eigenheads; then the full mesh."""
    few, span = min(settings.modes_first, modes), min(settings.modes, modes)
    last = settings.robust_px
    wider = [Stage("p95", modes, True, (2.0 * last, last), False, True, 4)] if modes > span else []
    return [
        Stage("p95", few, False, (20.0, 12.0, 7.2, 4.3), False, False, 3),
        Stage("p95", span, True, (6.0, 4.0, last), False, True, 4),
        Stage("p95", span, True, (20.0, 10.0, 5.0, 2.0 * last), True, True, 4),
        *wider,
        Stage("full", modes, True, (last,), False, True, 8),
    ]


def run_stage(problem: Problem, state: State, stage: Stage, report: Callable[[float], None]) -> tuple[State, int, str]:
    """Levenberg-Marquardt through the robust scales of one stage: state, evaluations, why it stopped."""
    few = state.coefficients[: stage.modes]
    state = replace(state, coefficients=np.concatenate([few, np.zeros(stage.modes - len(few))]))
    evaluations, reason = 0, "step limit"
    for i, scale in enumerate(stage.scales_px):
        report(i / len(stage.scales_px))
        coarse = scale > problem.settings.robust_px
        unit = max(problem.unit, coarse_unit(scale)) if coarse else problem.unit
        state, used, reason = _descend(replace(problem, unit=unit), state, stage, max(scale, problem.floor_px))
        evaluations += used
    return state, evaluations, reason


def _descend(problem: Problem, state: State, stage: Stage, scale_px: float) -> tuple[State, int, str]:
    """Levenberg-Marquardt at one robust scale.

    The set of rim samples changes with the state, which makes the cost slightly uneven: strict descent was seen to stop
    at ridges 0.3 mm from the minimum. So a step may climb back to the worst of the last costs (Grippo, Lampariello and
    Lucidi 1986), and the best state is returned.
    """
    damping = 1e-3
    now = best = evaluate(problem, state, stage, scale_px, None)
    best_state = state
    evaluations, recent = 1, [now.cost]
    reference = float(now.rim.length.sum())
    for _ in range(stage.steps):
        matrix, gradient = normal_equations(problem, state, now.rim, stage, scale_px)
        for _ in range(TRIES):
            damped = matrix + damping * np.diag(np.diag(matrix))
            step = -scipy.linalg.solve(damped, gradient, assume_a="pos", check_finite=False)
            moved = apply_step(state, step, stage)
            then = evaluate(problem, moved, stage, scale_px, reference)
            evaluations += 1
            if then.cost < max(recent[-NON_MONOTONE:]):
                break
            damping = max(damping * 100.0, 1e-2)
        else:
            return best_state, evaluations, "no step lowers the cost"
        state, now, damping = moved, then, max(damping * 0.1, 1e-7)
        recent.append(now.cost)
        if now.cost < best.cost:
            best, best_state = now, state
        if -float(gradient @ step) < problem.settings.tolerance:  # predicted fall: the step is short in its own sigma
            return best_state, evaluations, "converged"
    return best_state, evaluations, "step limit"


def coarse_unit(scale_px: float) -> float:
    """l sigma^2 (px^3) while residuals of that scale are let in: half of it counts as noise, so that the prior holds
    the shape. Without it hair over both ears pulled the first 15 modes to 8 standard deviations, and a head 5 mm."""
    return FIRST_CORRELATION_PX * (0.5 * scale_px) ** 2


def finish(solved: Solved) -> Fit:
    """The fit with its Laplace covariance: the inverse of the last normal matrix, cameras marginalised."""
    problem, state, stage = solved.problem, solved.state, solved.stage
    scale = max(stage.scales_px[-1], problem.floor_px)
    rim = evaluate(problem, state, stage, scale, None).rim
    matrix, _ = normal_equations(problem, state, rim, stage, scale)
    kept = stage.modes + POSE
    covariance = np.linalg.inv(matrix)[:kept, :kept]
    names = problem.views.names
    return Fit(
        method="contour",
        coefficients=state.coefficients,
        world_from_head=state.world_from_head,
        evaluations=solved.evaluations,
        stopped_because=solved.stopped_because,
        covariance=covariance,
        misfit_mm=solved.misfit_mm,
        used={name: bool((rim.view == k).any()) for k, name in enumerate(names)},
        camera_shift=dict(zip(names, state.camera_shift, strict=True)),
    )

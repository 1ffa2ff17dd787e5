"""Fits a head model to outlines by Levenberg-Marquardt. The paper's section 4.4 uses another cost and a simplex search.

The solver needs the silhouettes' signed distances, a start pose and, if there are any, feature points. The solver
returns coefficients, pose, camera corrections and their covariance. The modules ``*_term`` give the equations. The
scale of the robust loss shrinks step by step, since a start that is 20 px off needs a large scale. While the scale is
large, the prior keeps the shape from following clutter.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.compute.trace import traced
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.head_problem import started_problem
from pipeline.contour_fit.noise_model import is_hairless, mark_start_clutter, update_noise
from pipeline.contour_fit.posterior import cage_variance, estimate_prior
from pipeline.contour_fit.problem import (
    FIRST_CORRELATION_PX,
    POSE,
    ContourProblem,
    LandmarkObservations,
    Stage,
    StageEvidence,
    State,
    first_evidence,
    make_problem,
    start_state,
    widen,
)
from pipeline.contour_fit.rim_term import observed_rim
from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.positive_definite import inverse
from pipeline.estimation.terms import Linearised, NormalEquations, Problem
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from rig.geometry import Similarity
from rig.mesh import vertex_normals
from rig.progress import Progress, discard_progress
from rig.rig import Rig

LEVEL, STEPS = "p95", 4  # as the contour solver's own stage with more modes
FIRST_MODES = 15  # of the coarse stage; 10 to 20 measured alike
TOLERANCE = 0.05  # predicted fall of the cost at which the solver stops: a step of 0.2 sigma
TRIES = 3  # of a step, each with a hundred times the damping
NON_MONOTONE = 4  # costs that a step may climb back to


@dataclass(frozen=True, slots=True, eq=False)
class ContourSolution:
    """Holds the problem and the solution of the contour solver for later stages.

    ``evaluations`` counts evaluations of the cost. ``misfit_mm`` is copied into ``Fit``.
    """

    problem: ContourProblem
    evidence: StageEvidence
    state: State
    stage: Stage  # the last one
    evaluations: int
    termination_reason: str
    misfit_mm: Float[np.ndarray, " v0"] | None = None  # of ``Fit``


@traced
def solve_contour(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    *,
    features: Mapping[str, Mapping[str, np.ndarray]] | None = None,
    landmarks: LandmarkObservations | None = None,
    report: Progress = discard_progress,
) -> ContourSolution:
    """Fits the head's shape and pose, and small corrections of the cameras, to the usable silhouettes. The solver first
    fits ``settings.modes`` modes, then all modes. ``features`` are clicked pixels by camera and landmark; ``landmarks``
    are triangulated landmarks of the face. The function ``finish`` computes the covariance."""
    problem = make_problem(model, world_from_head, silhouettes, rig, settings, features or {}, landmarks=landmarks)
    few, span, whole, *rest = schedule(settings, len(model.modes))
    evidence, state = first_evidence(settings), start_state(problem, world_from_head)
    if landmarks is not None:
        evidence = mark_start_clutter(problem, evidence, state, few)
    state, spent, reason = run_stage(problem, evidence, state, few, lambda f: report("fit", 0.2 * f))
    state, used, reason = run_stage(problem, evidence, state, span, lambda f: report("fit", 0.2 + 0.2 * f))
    tried, more, _ = run_stage(problem, evidence, state, whole, lambda f: report("fit", 0.4 + 0.1 * f))
    spent += used + more
    bare = is_hairless(problem, evidence, tried, whole, state)
    if bare:
        state, span = tried, whole
    evidence = update_noise(problem, evidence, state, span)
    stage = span
    for i, stage in enumerate(rest):
        stage = replace(stage, whole_head=bare)
        state, used, reason = run_stage(
            problem, evidence, state, stage, lambda f, i=i: report("fit", 0.5 + 0.5 * (i + f) / len(rest))
        )
        spent += used
        evidence = update_noise(problem, evidence, state, stage)
    return ContourSolution(problem, evidence, state, stage, spent, reason)


def schedule(settings: FittingSettings, modes: int) -> list[Stage]:
    """Returns the stages of the fit, from coarse to fine, for a model of ``modes`` modes:

    - The first stage fits pose and a few modes on a decimated mesh.
    - The second stage fits all eigenheads to the face's rim.
    - The third stage fits all eigenheads to the whole head's rim, and its result is kept only if the head is bald.
    - The next stage fits the model's further modes, if there are any.
    - The last stage fits all modes on the full mesh.
    """
    few, span = min(FIRST_MODES, modes), min(settings.modes, modes)
    last = settings.robust_px
    wider = [Stage("p95", modes, True, (2.0 * last, last), False, True, 4)] if modes > span else []
    return [
        Stage("p95", few, False, (20.0, 12.0, 7.2, 4.3), False, False, 3),
        Stage("p95", span, True, (6.0, 4.0, last), False, True, 4),
        Stage("p95", span, True, (20.0, 10.0, 5.0, 2.0 * last), True, True, 4),
        *wider,
        Stage("full", modes, True, (last,), False, True, 8),
    ]


def run_stage(
    problem: ContourProblem, evidence: StageEvidence, state: State, stage: Stage, report: Callable[[float], None]
) -> tuple[State, int, str]:
    """Runs Levenberg-Marquardt once for each scale of the robust loss in a stage. Returns the state, the number of
    evaluations and the reason why the last search stopped.

    The set of rim samples changes with the state, so the cost is not quite continuous. A step may therefore raise the
    cost a little; a search without this allowance stopped 0.3 mm from the minimum.
    """
    few = state.coefficients[: stage.modes]
    state = replace(state, coefficients=np.concatenate([few, np.zeros(stage.modes - len(few))]))
    limits = Limits(stage.steps, TOLERANCE, TRIES, NON_MONOTONE)
    evaluations, reason = 0, "step limit"
    for i, scale in enumerate(stage.scales_px):
        report(i / len(stage.scales_px))
        seen = coarsen(evidence, scale) if scale > problem.settings.robust_px else evidence
        whole, at_start = started_problem(problem, seen, stage, max(scale, evidence.noise.floor_px), state)
        found = minimise(whole, state, limits, at_start=at_start)
        state, reason = found.value, found.evidence.termination_reason
        evaluations += found.evidence.evaluations
    return state, evaluations, reason


def coarsen(evidence: StageEvidence, scale_px: float) -> StageEvidence:
    """Returns the evidence for steps with a large scale of the robust loss. The outline's noise l sigma^2 (px^3) is
    raised to match a sigma of half the scale, at a fixed correlation length l.

    With noise of this size the prior outweighs the outlines. With less assumed noise, hair over both ears moved the
    head by 5 mm and its coefficients to 8 standard deviations.
    """
    unit = max(evidence.noise.unit, FIRST_CORRELATION_PX * (0.5 * scale_px) ** 2)
    return replace(evidence, noise=replace(evidence.noise, unit=unit))


def last_problem(solved: ContourSolution) -> tuple[Problem[State], Linearised]:
    """Returns the least-squares problem of the last stage, and its linearisation at the solution."""
    scale = max(solved.stage.scales_px[-1], solved.evidence.noise.floor_px)
    return started_problem(solved.problem, solved.evidence, solved.stage, scale, solved.state)


def normal_equations(solved: ContourSolution) -> NormalEquations:
    """Returns the normal equations of the last stage, evaluated at the solution."""
    whole, there = last_problem(solved)
    return whole.equations(there)


def hold_at_bounds(solved: ContourSolution, equations: NormalEquations) -> None:
    """Adds terms to the normal equations, in place, that keep expression weights at their bound 0. At a weight's bound
    the posterior is exponential instead of Gaussian, and its standard deviation is 1 / (slope of the cost)."""
    posed = np.asarray(solved.problem.model.posed, int)
    if len(posed) and posed[-1] < solved.stage.modes:
        held = posed[(solved.state.coefficients[posed] <= 0.0) & (equations.gradient[posed] > 0.0)]
        equations.matrix[held, held] += equations.gradient[held] ** 2


def finish(solved: ContourSolution) -> Fit:
    """Returns the fit with its Laplace covariance of shape and pose. The covariance is a block of the inverse of the
    last normal matrix, so it includes the uncertainty of the cameras."""
    problem, state, stage = solved.problem, solved.state, solved.stage
    kept, equations = stage.modes + POSE, normal_equations(solved)
    hold_at_bounds(solved, equations)
    covariance = inverse(equations.matrix)[:kept, :kept]
    rim = observed_rim(problem, solved.evidence, state, stage)
    names = problem.views.names
    return Fit(
        method="contour",
        coefficients=state.coefficients,
        world_from_head=state.world_from_head,
        evaluations=solved.evaluations,
        termination_reason=solved.termination_reason,
        covariance=covariance,
        misfit_mm=solved.misfit_mm,
        used={name: bool((rim.view == k).any()) for k, name in enumerate(names)},
        camera_shift=dict(zip(names, state.camera_shift, strict=True)),
    )


def add_span_misfit(solved: ContourSolution, wider_model: HeadModel, *, relief_mm: float) -> Fit:
    """Returns a fit with an estimate of the shape error that the eigenheads cannot represent.

    Few heads are exact combinations of the eigenheads, and the fit's covariance does not include the deviation. The
    shape error is small at the outlines and several times larger between them. The head's outlines are therefore fitted
    once more with additional modes (``gaussian_process``). The misfit combines the distance between the two fitted
    heads with the uncertainty of the second one.

    Args:
        solved: solution with the eigenheads alone.
        wider_model: the same mesh and eigenheads, followed by the kernel's modes.
        relief_mm: as in ``estimate_prior``.
    """
    fit, eigenheads = finish(solved), len(solved.state.coefficients)
    problem = widen(solved.problem, wider_model, (LEVEL,))
    last = solved.problem.settings.robust_px
    stage = Stage(LEVEL, len(wider_model.modes), True, (2.0 * last, last), solved.stage.whole_head, True, STEPS)
    state, evaluations, reason = run_stage(problem, solved.evidence, solved.state, stage, lambda fraction: None)
    wider = finish(ContourSolution(problem, solved.evidence, state, stage, evaluations, reason))
    wider = estimate_prior(wider_model, wider, eigenheads, relief_mm=relief_mm)
    return judged_by(wider_model, wider, solved.problem.model, fit)


def judged_by(wider_model: HeadModel, wider: Fit, model: HeadModel, fit: Fit) -> Fit:
    """Returns ``fit`` with a misfit (mm, along the normals) from its comparison with ``wider``, a fit of more modes to
    the same outlines. The squared misfit is the squared distance between the two fits plus the excess of the wider
    fit's variance. The fits ``fit`` and ``wider`` must have a covariance."""
    cage = fit.world_from_head.apply(model.cage(fit.coefficients))
    normals = vertex_normals(cage, model.levels["cage"].faces)
    apart = ((wider.world_from_head.apply(wider_model.cage(wider.coefficients)) - cage) * normals).sum(axis=1)
    square = apart**2 + cage_variance(wider_model, wider) - cage_variance(model, fit)
    return replace(fit, misfit_mm=np.sqrt(np.maximum(square, 0.0)), sliding_mm=wider.sliding_mm)

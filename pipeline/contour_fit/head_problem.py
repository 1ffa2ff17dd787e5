"""The complete problem of one stage at one robust scale: rim, points, photographs and priors as terms."""

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.feature_term import FeatureTerm
from pipeline.contour_fit.landmark_term import LandmarkTerm
from pipeline.contour_fit.prior_term import PriorTerm
from pipeline.contour_fit.problem import PER_CAMERA, POSE, ContourProblem, Stage, StageEvidence, State
from pipeline.contour_fit.rim_term import LinearisedRimTerm, RimTerm
from pipeline.contour_fit.surface_term import SurfaceTerm
from pipeline.estimation.terms import Linearised, Problem, Sum, Term
from rig.geometry import Similarity, rotation_from_vector


def head_problem(
    problem: ContourProblem,
    evidence: StageEvidence,
    stage: Stage,
    scale_px: float,
    reference_px: float | None = None,
) -> Problem[State]:
    """Builds the least-squares problem of one stage: all its terms as functions of shape, pose and, in stages that
    solve for them, cameras. ``scale_px`` is the robust scale of the contours, ``reference_px`` the outline length to
    which ``RimTerm`` scales its cost."""
    cameras = PER_CAMERA * len(problem.views.names) if stage.cameras else 0
    rim = RimTerm(problem, evidence, stage, scale_px, reference_px)
    terms: tuple[Term[State], ...] = (rim, *_other_terms(problem, evidence, stage))
    posed = problem.model.posed
    poses = len(posed) > 0 and posed.stop <= stage.modes
    return Problem(
        terms,
        stage.modes + POSE + cameras,
        lambda state, step: apply_step(state, step, stage),
        room=(lambda state: weight_bounds(state, posed, stage.modes + POSE + cameras)) if poses else None,
    )


def weight_bounds(state: State, posed: range, unknowns: int) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Returns the smallest and the largest step of every unknown that keep the expression weights between 0 and 1. All
    other unknowns are unbounded."""
    least, most = np.full(unknowns, -np.inf), np.full(unknowns, np.inf)
    weights = state.coefficients[posed.start : posed.stop]
    weights = np.clip(weights, 0.0, 1.0)
    least[posed.start : posed.stop], most[posed.start : posed.stop] = -weights, 1.0 - weights
    return least, most


def started_problem(
    problem: ContourProblem, evidence: StageEvidence, stage: Stage, scale_px: float, start: State
) -> tuple[Problem[State], Linearised]:
    """Returns the problem with its cost scaled to the outline length at ``start``, and its linearisation there. The rim
    at ``start`` is searched only once for both."""
    seen = RimTerm(problem, evidence, stage, scale_px).at(start)
    whole = head_problem(problem, evidence, stage, scale_px, float(seen.rim.length.sum()))
    rim, *others = whole.terms
    assert isinstance(rim, RimTerm)
    return whole, Sum((LinearisedRimTerm(rim, start, seen.rim), *(term.at(start) for term in others)))


def _other_terms(problem: ContourProblem, evidence: StageEvidence, stage: Stage) -> list[Term[State]]:
    terms: list[Term[State]] = []
    if problem.features is not None:
        terms.append(FeatureTerm(problem, problem.features, stage))
    if problem.landmarks is not None:
        terms.append(LandmarkTerm(problem.landmarks, stage, len(problem.views.names)))
    if evidence.photographs is not None:
        terms.append(SurfaceTerm(evidence.photographs.surface, stage))
    return [*terms, PriorTerm(problem, stage)]


def apply_step(state: State, step: Float[np.ndarray, " p"], stage: Stage) -> State:
    """Returns the state after a step. The step holds the stage's unknowns in this order: coefficients, pose,
    cameras."""
    m = stage.modes
    pose = state.world_from_head
    turned = rotation_from_vector(step[m : m + 3]) @ pose.rotation
    shift = state.camera_shift
    if stage.cameras:
        shift = shift + step[m + POSE :].reshape(shift.shape)
    moved = Similarity(pose.scale * float(np.exp(step[m + 6])), turned, pose.translation + step[m + 3 : m + 6])
    return State(state.coefficients + step[:m], moved, shift)

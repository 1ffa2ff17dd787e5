"""Builds the least-squares problem of one stage from its terms: rim, feature points, photographs and priors.

A feature point's residual is ``(pi(X) - picked) / sigma`` in both image axes. The feature point's sigma combines the
noise of a click with the projected variation of the landmark between heads. The robust loss is Geman and McClure's.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.landmark_term import LandmarkTerm
from pipeline.contour_fit.prior_term import PriorTerm
from pipeline.contour_fit.problem import (
    PER_CAMERA,
    POSE,
    ContourProblem,
    Observed,
    Stage,
    StageEvidence,
    State,
    moved_views,
)
from pipeline.contour_fit.rim_kernels import projected_with_slopes
from pipeline.contour_fit.rim_term import LinearisedRimTerm, RimTerm
from pipeline.contour_fit.surface_term import SurfaceTerm
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Linearised, Problem, Residuals, Sum, Term
from pipeline.head_model.landmarks import LANDMARK_NOISE_MM
from pipeline.multiview.triangulation import CLICK_NOISE_PX
from rig.geometry import Similarity, rotation_from_vector

FEATURE_SCALE = 4.0  # Geman-McClure scale of a feature point, in its standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class FeatureTerm:
    """Computes the cost of the feature points as a function of shape, pose and, if the stage solves for them, camera
    corrections."""

    problem: ContourProblem
    observed: Observed
    stage: Stage
    landmark_noise_mm: float = LANDMARK_NOISE_MM

    def at(self, state: State) -> Residuals:
        """Returns the offsets of all projected landmarks from their feature points, in standard deviations of a feature
        point, with Geman and McClure's loss."""
        observed, views = self.observed, moved_views(self.problem, state)
        moved = np.einsum("m,mnc->nc", state.coefficients, observed.basis[: len(state.coefficients)])
        points = state.world_from_head.apply(observed.mean + moved)
        pixels, slopes = projected_with_slopes(points, observed.view, views.packed())
        pixels_per_mm = np.linalg.norm(slopes, axis=(1, 2)) / np.sqrt(2.0)
        deviation_px = np.hypot(CLICK_NOISE_PX, self.landmark_noise_mm * pixels_per_mm)[:, None]
        return Residuals(
            (pixels - observed.pixel) / deviation_px,
            lambda: self._rows(state, points, slopes) / deviation_px[:, :, None],
            GemanMcClure(FEATURE_SCALE),
        )

    def _rows(
        self, state: State, points: Float[np.ndarray, "n 3"], slopes: Float[np.ndarray, "n 2 3"]
    ) -> Float[np.ndarray, "n 2 p"]:
        """Returns d(pixel) / d(unknowns) of each feature point; the change of its standard deviation is ignored."""
        observed, stage, views = self.observed, self.stage, moved_views(self.problem, state)
        pose, count = state.world_from_head, len(points)
        cameras = PER_CAMERA * len(views.names) if stage.cameras else 0
        rows = np.zeros((count, 2, stage.modes + POSE + cameras))
        turned = pose.scale * slopes @ pose.rotation
        rows[:, :, : stage.modes] = np.einsum("nad,mnd->nam", turned, observed.basis[: stage.modes], optimize=True)
        rotation, translation = views.rotation[observed.view], views.translation[observed.view]
        inside = np.einsum("nij,nj->ni", rotation, points) + translation
        columns = stage.modes + POSE + PER_CAMERA * observed.view[:, None] + np.arange(PER_CAMERA)
        for axis in range(2):
            rows[:, axis, stage.modes : stage.modes + POSE] = _pose_rows(points - pose.translation, slopes[:, axis])
            if stage.cameras:
                gradient = np.einsum("nij,nj->ni", rotation, slopes[:, axis])
                rows[np.arange(count)[:, None], axis, columns] = _pose_rows(inside, gradient)[:, :PER_CAMERA]
        return rows


def build_head_problem(
    problem: ContourProblem, evidence: StageEvidence, stage: Stage, scale_px: float, reference_px: float | None = None
) -> Problem[State]:
    """Builds the least-squares problem of one stage as a list of terms that depend on shape, pose and perhaps cameras.
    ``scale_px`` is the scale of the outlines' robust loss; ``reference_px`` is the outline length to which ``RimTerm``
    scales its cost."""
    cameras = PER_CAMERA * len(problem.views.names) if stage.cameras else 0
    rim = RimTerm(problem, evidence, stage, scale_px, reference_px)
    terms: tuple[Term[State], ...] = (rim, *_other_terms(problem, evidence, stage))
    posed = problem.model.posed
    poses = len(posed) > 0 and posed.stop <= stage.modes
    return Problem(
        terms,
        stage.modes + POSE + cameras,
        lambda state, step: apply_step(state, step, stage),
        room=(lambda state: weight_bounds(state, problem, stage.modes + POSE + cameras)) if poses else None,
    )


def weight_bounds(
    state: State, problem: ContourProblem, unknowns: int
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Returns the smallest and the largest step of every unknown that keep the expression weights between 0 and 1.
    Expressions that the current stage does not fit keep the weight 0. All other unknowns are unbounded."""
    posed = problem.model.posed
    least, most = np.full(unknowns, -np.inf), np.full(unknowns, np.inf)
    weights = state.coefficients[posed.start : posed.stop]
    weights = np.clip(weights, 0.0, 1.0)
    least[posed.start : posed.stop], most[posed.start : posed.stop] = -weights, 1.0 - weights
    held = [posed.start + row for row in problem.held]
    most[held] = least[held]
    return least, most


def started_problem(
    problem: ContourProblem, evidence: StageEvidence, stage: Stage, scale_px: float, start: State
) -> tuple[Problem[State], Linearised]:
    """Returns the least-squares problem, with its cost scaled to the outline length at ``start``, and its linearisation
    at ``start``."""
    seen = RimTerm(problem, evidence, stage, scale_px).at(start)
    whole = build_head_problem(problem, evidence, stage, scale_px, float(seen.rim.length.sum()))
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
    """Returns the state after a solver step. The step holds coefficients, pose and cameras in this order."""
    m = stage.modes
    pose = state.world_from_head
    turned = rotation_from_vector(step[m : m + 3]) @ pose.rotation
    shift = state.camera_shift
    if stage.cameras:
        shift = shift + step[m + POSE :].reshape(shift.shape)
    moved = Similarity(pose.scale * float(np.exp(step[m + 6])), turned, pose.translation + step[m + 3 : m + 6])
    return State(state.coefficients + step[:m], moved, shift)


def _pose_rows(arm: Float[np.ndarray, "s 3"], gradient: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "s 7"]:
    turn = np.cross(arm, gradient)  # g . (w x arm) = w . (arm x g)
    return np.concatenate([turn, gradient, (arm * gradient).sum(axis=1, keepdims=True)], axis=1)

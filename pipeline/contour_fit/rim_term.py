"""Computes the contour term: the signed distances of the model's rim samples from the silhouettes' outlines.

The residual of a rim sample at the pixel u is the silhouette's signed distance ``r = D_obs(u)`` (px), with

    dr/dz      = n^T P s R B            n^T P from rim.py, B the modes at the sample
    dr/dpose   = n^T P [-[X - c]x, I, X - c]        rotation and log scale about the head's place c, translation
    dr/dcamera = n^T P_c [-[X_c]x, I]               left perturbation of camera_from_world

Each sample represents ``length`` px of outline. The weight of a sample is ``length / (l sigma^2)``, the Fisher
information of an outline with noise sigma and correlation length l.

Clutter (hair, shoulders, clothes) only adds area, so the silhouette's outline may lie outside the model but hardly ever
inside. The scale of the robust loss (Geman-McClure) is therefore small where the model lies inside the silhouette, and
large where the model sticks out.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32

from pipeline.compute.threads import in_threads
from pipeline.contour_fit.clutter import downweight_outside_contour, drop_clutter, restore_bare_crown
from pipeline.contour_fit.problem import PER_CAMERA, POSE, ContourProblem, Stage, StageEvidence, State, moved_views
from pipeline.contour_fit.rim import Rim, find_rim
from pipeline.contour_fit.rim_kernels import Level, RimSamples, fill_rows
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import NormalEquations

OUTSIDE_SCALE = 2.0  # robust scale where the model sticks out of the input, by the other side's; 3 (10 px at least)
# left 20 % of bad contour ten times the error


def observed_rim(problem: ContourProblem, evidence: StageEvidence, state: State, stage: Stage) -> Rim:
    """Returns the rim of the head at ``state``, with weights of its samples from ``stage`` and ``evidence``. Outline
    samples in clutter have length 0."""
    vertices = state.world_from_head.apply(problem.bases[stage.level].vertices(state.coefficients))
    # On a decimated mesh a sample's share of the outline is long enough to be half clutter: it would hide what is not.
    fine, whole = stage.level == "full", stage.whole_head or stage.contained
    views = moved_views(problem, state)
    rim = find_rim(problem.topologies[stage.level], vertices, views, whole_head=whole, averaged=fine)
    counted = drop_clutter(evidence, rim)
    if stage.contained and not stage.whole_head:
        counted = downweight_outside_contour(problem, evidence, counted, stage.level)
    return restore_bare_crown(problem, evidence, counted, rim.length, stage.level)


@dataclass(frozen=True, slots=True, eq=False)
class RimTerm:
    """Computes the cost of the silhouettes' outlines. ``scale_px`` is the scale of the robust loss. The cost is
    normalised to an outline of ``reference_px`` (None: not), so that hiding a part of the rim does not lower the
    cost."""

    problem: ContourProblem
    evidence: StageEvidence
    stage: Stage
    scale_px: float
    reference_px: float | None = None

    def at(self, state: State) -> "LinearisedRimTerm":
        """Finds the rim at ``state`` and returns the term linearised there."""
        return LinearisedRimTerm(self, state, observed_rim(self.problem, self.evidence, state, self.stage))


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedRimTerm:
    """Holds the rim term linearised at one state, with the rim samples there."""

    term: RimTerm
    state: State
    rim: Rim

    @property
    def cost(self) -> float:
        """Returns the robust cost of all samples in squared standard deviations, weighted by their outline length."""
        rho = _loss(self.rim.residual, self.term.scale_px).cost(self.rim.residual**2)
        total = float(self.rim.length.sum())
        share = (self.term.reference_px or total) / max(total, 1.0)
        return float((self.rim.length * rho).sum()) / self.term.evidence.noise.unit * share

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the rim samples to the normal equations in place, camera by camera, since a sample depends on only one
        camera's correction."""
        stage, rim = self.term.stage, active_samples(self.rim)
        rows = rim_rows(self.term.problem, self.state, rim, stage)
        weight = _loss(rim.residual, self.term.scale_px).weight(rim.residual**2)
        root = np.sqrt(weight * rim.length / self.term.evidence.noise.unit).astype(np.float32)
        rows *= root[:, None]
        shared, views = stage.modes + POSE, len(self.term.problem.views.names)
        ends = np.searchsorted(rim.view, np.arange(views + 1))
        matrix, gradient = equations.matrix, equations.gradient
        common, residual = rows[:, :shared], root * rim.residual.astype(np.float32)
        matrix[:shared, :shared] += common.T @ common  # A^T A: half the work of A^T B
        gradient[:shared] += residual @ common
        if not stage.cameras:
            return
        for k, (first, last) in enumerate(pairwise(ends)):
            part, columns = rows[first:last, shared:], slice(shared + PER_CAMERA * k, shared + PER_CAMERA * (k + 1))
            across = common[first:last].T @ part
            matrix[:shared, columns] += across
            matrix[columns, :shared] += across.T
            matrix[columns, columns] += part.T @ part
            gradient[columns] += residual[first:last] @ part


def _loss(residual_px: Float[np.ndarray, " s"], scale_px: float) -> GemanMcClure:
    """Returns the robust loss of residuals. The scale of the loss is ``OUTSIDE_SCALE`` times larger where the model
    sticks out of the silhouette."""
    return GemanMcClure(np.where(residual_px < 0, scale_px, OUTSIDE_SCALE * scale_px))


def active_samples(rim: Rim) -> Rim:
    """Returns the indices of the samples with a length above 0."""
    kept = rim.length > 0
    return rim if kept.all() else Rim(*(getattr(rim, name)[kept] for name in Rim.__dataclass_fields__))


def rim_rows(problem: ContourProblem, state: State, rim: Rim, stage: Stage) -> Float32[np.ndarray, "s q"]:
    """Returns the derivative of each sample's residual (px) by coefficients, pose and camera correction, in columns of
    this order."""
    pose, views = state.world_from_head, moved_views(problem, state)
    basis = problem.bases[stage.level]
    operator = basis.operator
    rows = np.empty((len(rim.view), stage.modes + POSE + PER_CAMERA), np.float32)
    # One type for every level, or the loop is compiled once for each.
    level = Level(operator.indptr.astype(np.int64), operator.indices.astype(np.int64), operator.data, basis.modes)
    samples = RimSamples(
        rim.view, rim.corner, *(np.ascontiguousarray(part) for part in (rim.blend, rim.point, rim.gradient))
    )
    turn, cameras = pose.scale * pose.rotation, views.packed()

    def fill(first: int, last: int) -> None:
        fill_rows(first, last, level, stage.modes, turn, pose.translation, cameras, samples, rows)

    in_threads(len(rows), fill)
    return rows

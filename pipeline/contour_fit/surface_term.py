"""Computes the surface term: point-to-plane residuals of surface observations from photographs.

An observation states that a vertex of the full mesh lies ``displacement`` mm along a normal from its position X_seen
during the observation, with an information (mm^-2). A shift along the surface has no cost. Moving camera k by c_k moves
the observed point by ``by_camera . c_k``. Image shifts that no surface explains constrain the cameras alone, through M
(``camera_matrix``). With

    e = n . (X(theta) - X_seen) - displacement - by_camera . (c - c_seen)

With the residual e, the term is ``sum information rho(e) + (c - c_seen)^T M (c - c_seen) - 2 g^T (c - c_seen)``. The
function rho is the loss of Geman and McClure with a scale of ``FORGIVEN_SIGMAS``. Some observations, as from hair, are
upper bounds: they count only where e is positive, that is, where the head sticks out.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from pipeline.contour_fit.problem import Stage, State, SurfaceObservations
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import LinearisedQuadratic, NormalEquations, Quadratic
from rig.geometry import Similarity

Points = Float[np.ndarray, "n 3"]

FORGIVEN_SIGMAS = 3.0
LOSS = GemanMcClure(FORGIVEN_SIGMAS)


def surface_residual(
    seen: SurfaceObservations,
    coefficients: Float[np.ndarray, " m"],
    world_from_head: Similarity,
    camera_shift: Float[np.ndarray, "k 6"],
) -> tuple[Float[np.ndarray, " n"], Points]:
    """Returns the residual e (mm) of each observation and the current positions of the vertices (world frame, mm). An
    upper bound, as from hair, has the residual 0 while the head stays inside."""
    count = len(coefficients)
    moved = (coefficients.astype(np.float32) @ seen.basis[:count].reshape(count, -1)).reshape(-1, 3)
    points = world_from_head.apply(seen.mean + moved)
    along = ((points - seen.seen_at) * seen.normal).sum(axis=1)
    off = along - seen.displacement - seen.by_camera @ (camera_shift - seen.camera_shift).ravel()
    return np.where(seen.bound, np.maximum(off, 0.0), off), points


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceTerm:
    """Computes the cost of the surface observations as a function of shape, pose and, if the stage solves for them,
    camera corrections."""

    seen: SurfaceObservations
    stage: Stage

    def at(self, state: State) -> "LinearisedSurfaceTerm":
        """Returns the surface term, linearised at ``state``."""
        residual, points = surface_residual(self.seen, state.coefficients, state.world_from_head, state.camera_shift)
        return LinearisedSurfaceTerm(self, state, residual, points)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedSurfaceTerm:
    """Holds the surface term linearised at one state: the residuals e (mm) and the current positions of the vertices
    (world, mm)."""

    term: SurfaceTerm
    state: State
    residual: Float[np.ndarray, " n"]
    points: Points

    @property
    def squares(self) -> Float[np.ndarray, " n"]:
        """Returns the squared residual of each observation, in squared standard deviations."""
        return self.term.seen.information * self.residual**2

    @property
    def cameras(self) -> LinearisedQuadratic:
        """Returns the quadratic cost of the cameras' corrections, whose matrix was measured together with the
        surface."""
        seen = self.term.seen
        form = Quadratic(seen.camera_matrix, seen.camera_shift.ravel(), seen.camera_gradient)
        return form.at(self.state.camera_shift.ravel())

    @property
    def cost(self) -> float:
        """Returns the robust cost of all observations plus the cost of the cameras' corrections, in squared standard
        deviations."""
        return float(LOSS.cost(self.squares).sum()) + self.cameras.cost

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the surface term to the normal equations in place. Upper bounds that the head satisfies add nothing."""
        seen, stage, state = self.term.seen, self.term.stage, self.state
        rows = surface_rows(seen, stage.modes, state.world_from_head, self.points, cameras=stage.cameras)
        counts = ~seen.bound | (self.residual > 0.0)
        root = np.sqrt(seen.information * LOSS.weight(self.squares) * counts)
        rows *= root.astype(np.float32)[:, None]
        equations.matrix[...] += rows.T @ rows  # A^T A: half the work of A^T B
        equations.gradient[...] += (root * self.residual).astype(np.float32) @ rows
        if stage.cameras:
            tail = slice(len(equations.gradient) - seen.by_camera.shape[1], None)
            self.cameras.add_to(NormalEquations(equations.matrix[tail, tail], equations.gradient[tail]))


def surface_rows(
    seen: SurfaceObservations, count: int, world_from_head: Similarity, points: Points, *, cameras: bool
) -> Float32[np.ndarray, "n p"]:
    """Returns the derivative of each residual e (mm) by the first ``count`` coefficients, rotation, translation, log
    scale and, if ``cameras``, the cameras' corrections, in columns of this order. ``points`` are the current vertices
    (world, mm)."""
    turned = (world_from_head.scale * (seen.normal @ world_from_head.rotation)).astype(np.float32)
    shape = np.einsum("nc,mnc->nm", turned, seen.basis[:count], optimize=True)
    arm = points - world_from_head.translation
    blocks = [shape, np.cross(arm, seen.normal), seen.normal, (arm * seen.normal).sum(axis=1, keepdims=True)]
    if cameras:
        blocks.append(-seen.by_camera)
    return np.concatenate(blocks, axis=1, dtype=np.float32)

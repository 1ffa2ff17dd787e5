"""Computes the bundle's main term: the reprojection errors of the board's corners.

    r = (pi(camera_from_world @ (world_from_board @ X)) - detected) / sigma_c

sigma_c is each camera's own noise; a robust loss is applied to |r|^2. A view (one camera, one shot) depends on 15
parameters of its camera, 6 of its board and one time offset, so the normal equations are assembled from blocks of
22 x 22, one for each view.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from calibration.adjustment.state import (
    DEPTH_LEAST_MM,
    PER_CAMERA,
    PER_SHOT,
    BundleState,
    Observations,
    corner_positions,
    residuals,
)
from pipeline.estimation.robust import LeastSquares, Loss
from pipeline.estimation.terms import NormalEquations
from rig.camera import lens_jacobians
from rig.geometry import cross_matrix


@dataclass(frozen=True, slots=True, eq=False)
class CornerTerm:
    """Computes the cost of all corners as a function of the state. ``sigma_px`` is the noise of a corner's coordinate
    in each camera."""

    seen: Observations
    sigma_px: Float[np.ndarray, " c"]
    loss: Loss = field(default_factory=LeastSquares)

    def at(self, state: BundleState) -> "LinearisedCornerTerm":
        """Returns the term at a state."""
        noise = self.sigma_px[self.seen.camera[self.seen.view_of]]
        return LinearisedCornerTerm(self, state, residuals(state, self.seen) / noise[:, None], noise)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedCornerTerm:
    """Holds the residuals of all corners at one state."""

    term: CornerTerm
    state: BundleState
    residual: Float[np.ndarray, "n 2"]  # in standard deviations
    noise_px: Float[np.ndarray, " n"]

    @property
    def cost(self) -> float:
        """Returns the sum of the robust loss over all corners."""
        return float(self.term.loss.cost((self.residual**2).sum(axis=1)).sum())

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the blocks of all views to the normal equations."""
        observed, cameras = self.term.seen, len(self.state.intrinsics)
        weight = np.sqrt(self.term.loss.weight((self.residual**2).sum(axis=1)))
        blocks = np.concatenate([self.by_view(), self.residual[:, :, None]], axis=2)
        blocks = (blocks * weight[:, None, None]).reshape(2 * len(self.residual), -1)
        for view, at in enumerate(places(observed, cameras, len(equations.gradient))):
            block = blocks[2 * observed.starts[view] : 2 * observed.starts[view + 1]]
            product = block.T @ block
            equations.matrix[np.ix_(at, at)] += product[:-1, :-1]
            equations.gradient[at] += product[:-1, -1]

    def by_view(self) -> Float[np.ndarray, "n 2 22"]:
        """Returns the derivatives of each corner by the 22 parameters of its view: camera (15), board (6), time offset
        (1)."""
        state, observed = self.state, self.term.seen
        world, inside, camera = corner_positions(state, observed)
        behind = inside[:, 2] < DEPTH_LEAST_MM
        inside[behind] = (0.0, 0.0, 1.0)
        by_point, by_lens = lens_jacobians(inside, state.intrinsics[camera])
        by_world = by_point @ state.camera_rotations[camera]
        by_board = np.concatenate([-by_world @ cross_matrix(world), by_world], axis=2)
        by_offset = by_board @ state.velocities[observed.shot[observed.view_of]][:, :, None]
        by_camera = [by_lens, -by_point @ cross_matrix(inside), by_point]
        rows = np.concatenate([*by_camera, by_board, by_offset], axis=2)
        rows[behind] = 0.0
        rows /= self.noise_px[:, None, None]
        return rows

    def jacobian(self, size: int) -> Float[np.ndarray, "n 2 q"]:
        """Returns the derivatives of each corner by all ``size`` parameters, mostly zeros; for tests and other
        solvers."""
        observed, rows = self.term.seen, self.by_view()
        whole = np.zeros((*rows.shape[:2], size))
        for view, at in enumerate(places(observed, len(self.state.intrinsics), size)):
            of_view = slice(observed.starts[view], observed.starts[view + 1])
            whole[of_view, :, at] = rows[of_view]
        return whole


def places(observed: Observations, cameras: int, size: int) -> Int[np.ndarray, "v 22"]:
    """Returns, for each view, the indices of its 22 parameters: those of its camera, its board, and its camera's time
    offset."""
    of_camera = observed.camera[:, None] * PER_CAMERA + np.arange(PER_CAMERA)
    board = cameras * PER_CAMERA + observed.shot[:, None] * PER_SHOT + np.arange(PER_SHOT)
    return np.concatenate([of_camera, board, size - cameras + observed.camera[:, None]], axis=1)

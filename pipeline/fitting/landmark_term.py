"""The landmark term: where places of the face were found in the world, against where the head has them.

With a place ``X(theta)`` of the head, its found position ``x`` and the covariance ``S`` of the difference (the
triangulation's, and how far a network's idea of the place is off on other heads),

    r = W (X(theta) - x),    W^T W = S^-1
    dr / d(coefficients) = W s R B,    dr / d(rotation, translation, log s) = W [-[X - t]x, I, X - t]

under Geman and McClure's loss of ``|r|``. All places are found by one network, whose errors on one face hang together
(an open mouth, a turned head): n places count as ``INDEPENDENT`` ones.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.eigenheads.model import HeadModel
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Residuals
from pipeline.fitting.problem import PER_CAMERA, POSE, LandmarkObservations, Stage, State, blended_basis
from rig.geometry import cross_matrix

FORGIVEN_SIGMAS = 4.0  # Geman-McClure scale, in standard deviations: a jaw that moved, a brow under hair
INDEPENDENT = 12.0  # landmarks that tell as much as all of them: eyes, brows, nose, mouth, cheeks, chin by side


def observe_landmarks(
    model: HeadModel,
    corner: Int[np.ndarray, "n 3"],
    blend: Float[np.ndarray, "n 3"],
    position_world: Float[np.ndarray, "n 3"],
    covariance_world: Float[np.ndarray, "n 3 3"],
) -> LandmarkObservations:
    """Returns landmarks as the solver reads them.

    Args:
        model: with the modes of the fit.
        corner: vertices of the full level about each place.
        blend: their weights, which sum to 1.
        position_world: where the place was found, mm.
        covariance_world: of the found position and of the place on other heads together, mm^2.
    """
    shared = max(len(corner) / INDEPENDENT, 1.0)
    whiten = np.linalg.cholesky(np.linalg.inv(shared * covariance_world)).transpose(0, 2, 1)
    mean, basis = blended_basis(model, corner, blend)
    return LandmarkObservations(corner, blend, position_world, whiten, mean, basis)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkTerm:
    """Over (coefficients, pose, cameras, which it does not depend on)."""

    observed: LandmarkObservations
    stage: Stage
    cameras: int  # in the problem

    def at(self, state: State) -> Residuals:
        points = landmark_points(self.observed, state)
        residual = np.einsum("nij,nj->ni", self.observed.whiten, points - self.observed.position_world)
        return Residuals(residual, lambda: self._rows(state, points), GemanMcClure(FORGIVEN_SIGMAS))

    def _rows(self, state: State, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 p"]:
        observed, stage, pose = self.observed, self.stage, state.world_from_head
        cameras = PER_CAMERA * self.cameras if stage.cameras else 0
        rows = np.zeros((len(points), 3, stage.modes + POSE + cameras))
        turned = pose.scale * observed.whiten @ pose.rotation
        rows[:, :, : stage.modes] = np.einsum("nad,mnd->nam", turned, observed.basis[: stage.modes], optimize=True)
        arm = points - pose.translation
        by_pose = np.concatenate(
            [np.stack([-cross_matrix(x) for x in arm]), np.tile(np.eye(3), (len(arm), 1, 1)), arm[:, :, None]], axis=2
        )
        rows[:, :, stage.modes : stage.modes + POSE] = observed.whiten @ by_pose
        return rows


def landmark_points(observed: LandmarkObservations, state: State) -> Float[np.ndarray, "n 3"]:
    """Returns where the head has the landmarks, world, mm."""
    moved = np.einsum("m,mnc->nc", state.coefficients, observed.basis[: len(state.coefficients)])
    return state.world_from_head.apply(observed.mean + moved)

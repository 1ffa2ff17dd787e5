"""Computes the landmark term: the differences between triangulated face landmarks and the head model's landmarks.

``X(theta)`` are the head model's landmarks, stacked, and ``x`` the triangulated ones. The covariance ``S`` of their
difference has two parts: the error of triangulation, and the network's error, which is common to all landmarks. The
residual is

    r = W (X(theta) - x),    W^T W = S^-1
    dr / d(coefficients) = W s R B,    dr / d(rotation, translation, log s) = W [-[X - t]x, I, X - t]

All landmarks form one residual under Geman and McClure's loss, so a wrong face loses its weight as a whole. A landmark
that contradicts the others has a larger variance in ``S`` (``alignment.face_alignment``).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.contour_fit.problem import PER_CAMERA, POSE, LandmarkObservations, Stage, State, blended_basis
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Residuals
from pipeline.head_model.model import HeadModel
from rig.geometry import cross_matrix

FORGIVEN_SIGMAS = 3.0  # RMS of all coordinates, beyond which the landmarks are another face's


def observe_landmarks(
    model: HeadModel,
    corner: Int[np.ndarray, "n 3"],
    blend: Float[np.ndarray, "n 3"],
    position_world: Float[np.ndarray, "n 3"],
    covariance_world: Float[np.ndarray, "p p"],
) -> LandmarkObservations:
    """Packs triangulated landmarks for the solver, with the mean and modes of the model at each landmark.

    Args:
        model: the head model with all modes of the fit.
        corner: the three vertices of the full mesh around each landmark.
        blend: their weights, which sum to 1.
        position_world: each landmark's triangulated position, mm.
        covariance_world: covariance (mm^2) of the difference between head and observation, over all coordinates: x, y,
            z of the first landmark, then of the second, and so on.
    """
    whiten = np.linalg.inv(np.linalg.cholesky(covariance_world))
    mean, basis = blended_basis(model, corner, blend)
    return LandmarkObservations(corner, blend, position_world, whiten, mean, basis)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkTerm:
    """Computes the cost of the face's triangulated landmarks as a function of shape and pose. The cost does not depend
    on cameras; ``cameras`` is the number of columns of zeros in its Jacobian."""

    observed: LandmarkObservations
    stage: Stage
    cameras: int  # in the problem

    def at(self, state: State) -> Residuals:
        """Returns the differences between the head's landmarks and the triangulated landmarks, in standard deviations.
        The differences form one residual under Geman and McClure's loss, so that all landmarks lose their weight
        together."""
        observed = self.observed
        moved = np.einsum("m,mnc->nc", state.coefficients, observed.basis[: len(state.coefficients)])
        points = state.world_from_head.apply(observed.mean + moved)
        residual = observed.whiten @ (points - observed.position_world).ravel()
        loss = GemanMcClure(FORGIVEN_SIGMAS * np.sqrt(len(residual)))
        return Residuals(residual[None], lambda: self._rows(state, points)[None], loss)

    def _rows(self, state: State, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "p u"]:
        observed, stage, pose = self.observed, self.stage, state.world_from_head
        cameras = PER_CAMERA * self.cameras if stage.cameras else 0
        rows = np.zeros((len(points), 3, stage.modes + POSE + cameras))
        turned = pose.scale * (observed.basis[: stage.modes] @ pose.rotation.T)
        rows[:, :, : stage.modes] = turned.transpose(1, 2, 0)
        arm = points - pose.translation
        by_pose = [-cross_matrix(arm), np.tile(np.eye(3), (len(arm), 1, 1)), arm[:, :, None]]
        rows[:, :, stage.modes : stage.modes + POSE] = np.concatenate(by_pose, axis=2)
        return observed.whiten @ rows.reshape(3 * len(points), -1)

"""The feature term: where a landmark was picked, against where its vertex is seen.

Residual: ``(pi(X) - picked) / sigma`` in both image axes, sigma a click's noise and, as far as the camera sees it, the
landmark's place on another head; Geman and McClure's loss of its norm.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.problem import PER_CAMERA, POSE, ContourProblem, Observed, Stage, State, moved_views
from pipeline.contour_fit.rim import project_with_slopes
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Residuals
from pipeline.head_model.landmarks import LANDMARK_NOISE_MM
from pipeline.multiview.triangulation import CLICK_NOISE_PX

FEATURE_SCALE = 4.0  # Geman-McClure scale of a feature point, in its standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class FeatureTerm:
    """Computes the cost of the feature points as a function of shape, pose and, in stages that solve for them, camera
    corrections."""

    problem: ContourProblem
    observed: Observed
    stage: Stage

    def at(self, state: State) -> Residuals:
        """Returns the offsets of all projected landmarks from their feature points, in standard deviations of a feature
        point, with Geman and McClure's loss."""
        observed, views = self.observed, moved_views(self.problem, state)
        moved = np.einsum("m,mnc->nc", state.coefficients, observed.basis[: len(state.coefficients)])
        points = state.world_from_head.apply(observed.mean + moved)
        pixels, slopes = project_with_slopes(points, observed.view, views)
        deviation_px = self._deviation_px(slopes)[:, None]
        return Residuals(
            (pixels - observed.pixel) / deviation_px,
            lambda: self._rows(state, points, slopes) / deviation_px[:, :, None],
            GemanMcClure(FEATURE_SCALE),
        )

    def _deviation_px(self, slopes: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
        """Returns the standard deviation (px) of each feature point: a click's noise together with the landmark's
        variation between heads."""
        pixels_per_mm = np.linalg.norm(slopes, axis=(1, 2)) / np.sqrt(2.0)
        return np.hypot(CLICK_NOISE_PX, LANDMARK_NOISE_MM * pixels_per_mm)

    def _rows(
        self, state: State, points: Float[np.ndarray, "n 3"], slopes: Float[np.ndarray, "n 2 3"]
    ) -> Float[np.ndarray, "n 2 p"]:
        """Returns d(pixel) / d(unknowns) of each feature point; the change of its deviation is ignored."""
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


def _pose_rows(arm: Float[np.ndarray, "s 3"], gradient: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "s 7"]:
    turn = np.cross(arm, gradient)  # g . (w x arm) = w . (arm x g)
    return np.concatenate([turn, gradient, (arm * gradient).sum(axis=1, keepdims=True)], axis=1)

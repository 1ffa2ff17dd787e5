"""Turns the rims of a head fitted to one capture into equations for the cameras alone.

With the cameras fixed, the contour solver (section 4.4, ``pipeline.contour_fit.contour``) estimates shape and pose. Its
normal equations at the solution, over (shape, pose, cameras), are reduced to the cameras by the Schur complement, so
that the uncertainty of the head's shape is accounted for. The equations of several captures add up: each has a head of
its own, and all share the cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from jaxtyping import Float

from pipeline.contour_fit.contour import solve_contour
from pipeline.contour_fit.head_problem import head_problem
from pipeline.contour_fit.problem import PER_CAMERA
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from rig.geometry import Similarity
from rig.rig import Rig

HELD_PX = 0.01  # prior that keeps cameras fixed in the fit: a tenth of the errors sought


@dataclass(frozen=True, slots=True, eq=False)
class Heads:
    """Holds a model for the heads of all captures, and the pose at which the fit of each capture's head starts
    (``world_from_head``)."""

    model: HeadModel
    starts: Sequence[Similarity]
    settings: FittingSettings = field(default_factory=FittingSettings)

    def subset(self, chosen: Sequence[int]) -> "Heads":
        """Returns the heads of the captures with the indices ``chosen``."""
        return replace(self, starts=[self.starts[i] for i in chosen])


def rim_equations(
    silhouettes: Mapping[str, Silhouette], rig: Rig, heads: Heads, start: Similarity
) -> tuple[Float[np.ndarray, "c6 c6"], Float[np.ndarray, " c6"]]:
    """Returns normal matrix and gradient of the rims' cost over the left perturbations (rad, mm) of all cameras.

    They are zero for cameras without a usable silhouette. Raises ValueError if no silhouette is usable."""
    bare = Rig(tuple(replace(camera, covariance=None) for camera in rig))  # the caller adds the prior
    solved = solve_contour(heads.model, start, silhouettes, bare, replace(heads.settings, calibration_px=HELD_PX))
    problem = replace(solved.problem, camera_information=np.zeros_like(solved.problem.camera_information))
    stage = replace(solved.stage, cameras=True)
    scale_px = max(stage.scales_px[-1], solved.evidence.noise.floor_px)
    whole = head_problem(problem, solved.evidence, stage, scale_px)
    equations = whole.equations(whole.at(solved.state))
    matrix, gradient = equations.matrix, equations.gradient
    head_size = len(gradient) - PER_CAMERA * len(problem.views.names)
    head = scipy.linalg.cho_factor(matrix[:head_size, :head_size])
    across = matrix[head_size:, :head_size]
    reduced = matrix[head_size:, head_size:] - across @ scipy.linalg.cho_solve(head, across.T)
    slope = gradient[head_size:] - across @ scipy.linalg.cho_solve(head, gradient[:head_size])
    at = np.concatenate([PER_CAMERA * rig.names.index(name) + np.arange(PER_CAMERA) for name in problem.views.names])
    full, full_slope = np.zeros((PER_CAMERA * len(rig),) * 2), np.zeros(PER_CAMERA * len(rig))
    full[np.ix_(at, at)], full_slope[at] = 0.5 * (reduced + reduced.T), slope
    return full, full_slope

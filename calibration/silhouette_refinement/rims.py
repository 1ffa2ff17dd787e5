"""What the rims of a head say of the cameras: the model fitted to one capture, everything but the cameras taken out.

With the cameras held, the contour solver (section 4.4, ``pipeline.contour_fit.contour``) finds shape and pose. The
normal equations there, over (shape, pose, cameras), are reduced to the cameras by the Schur complement, so that a head
which could be another one says no more than it knows. Captures of several subjects add up: heads are their own, cameras
the same.
"""

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

HELD_PX = 0.01  # as the cameras' prior: a tenth of what is looked for


@dataclass(frozen=True, slots=True, eq=False)
class Heads:
    """Holds a model for all captures, and where each capture's head is to start from (``world_from_head``)."""

    model: HeadModel
    starts: Sequence[Similarity]
    settings: FittingSettings = field(default_factory=FittingSettings)

    def subset(self, chosen: Sequence[int]) -> "Heads":
        """Returns the heads of some of the captures."""
        return replace(self, starts=[self.starts[i] for i in chosen])


def rim_equations(
    silhouettes: Mapping[str, Silhouette], rig: Rig, heads: Heads, start: Similarity
) -> tuple[Float[np.ndarray, "c6 c6"], Float[np.ndarray, " c6"]]:
    """Normal matrix and gradient over the left perturbations (rad, mm) of all cameras; zero for those without a usable
    silhouette. Raises ValueError where none is usable."""
    bare = Rig(tuple(replace(camera, covariance=None) for camera in rig))  # the prior is the caller's
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

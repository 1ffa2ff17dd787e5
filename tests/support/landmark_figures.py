"""How well the points of a found face fit the truth of a capture that was drawn from ICT-FaceKit."""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.faces.landmark_map import LandmarkMap
from pipeline.faces.matching import MatchedFaces

ICT_VERTICES = 11248  # come first in the truths that are drawn from ICT-FaceKit
EVERY = 9


def head_axes(truth: Path) -> Float[np.ndarray, "3 3"]:
    """world_from_head's rotation of a capture's truth."""
    meta = json.loads((truth / "meta.json").read_text(encoding="utf-8"))
    return np.array(meta["world_from_head"]["rotation"])


def chi_square(
    found: MatchedFaces, of_model: LandmarkMap, true: Float[np.ndarray, "468 3"], axes: Float[np.ndarray, "3 3"]
) -> float:
    """Squares of errors by their covariance, a degree of freedom: of each point's own noise, each view's, and the
    map's. Of every ``EVERY``-th point that does not slide: with all, a covariance of few modes would be rounding."""
    which = np.flatnonzero(~of_model.slides)[::EVERY]
    errors = (found.points_world - true)[which] @ axes - of_model.offset_mm[which]
    views = (found.shared_mm[:, which] @ axes).reshape(len(found.shared_mm), -1)
    of_points = np.zeros((len(which), 3, len(which), 3))
    of_points[np.arange(len(which)), :, np.arange(len(which)), :] = axes.T @ found.covariances[which] @ axes
    covariance = of_model.covariance(which) + views.T @ views + of_points.reshape(errors.size, -1)
    return float(errors.ravel() @ np.linalg.solve(covariance, errors.ravel()) / errors.size)

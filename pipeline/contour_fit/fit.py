"""Defines the result of a solver, common to the contour solver and the simplex."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from rig.geometry import Similarity


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Holds a head model fitted to the silhouettes.

    ``coefficients`` are in standard deviations of the model's modes. ``covariance`` is over coefficients, rotation
    (rad, applied on the left about the head's origin), translation (mm) and log scale, in this order; None if the
    solver computes none.
    """

    method: str
    coefficients: Float[np.ndarray, " m"]
    world_from_head: Similarity
    evaluations: int
    termination_reason: str
    covariance: Float[np.ndarray, "p p"] | None = None
    misfit_mm: Float[np.ndarray, " v0"] | None = None  # by cage vertex: relief that no mode follows
    sliding_mm: float = 0.0  # standard deviation of a place along the surface, beyond what the covariance says
    used: Mapping[str, bool] = field(default_factory=dict)  # by camera: did it speak?
    camera_shift: Mapping[str, Float[np.ndarray, " 6"]] = field(default_factory=dict)  # left perturbation, rad and mm

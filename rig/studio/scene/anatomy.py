"""Finds the few points of a head from which hair, paint and clothes are laid out."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Landmarks = Mapping[str, Float[np.ndarray, " 3"]]

PAINTED = (
    "exocanthion_right", "exocanthion_left", "endocanthion_right", "endocanthion_left", "glabella", "pronasale",
    "cheilion_right", "cheilion_left", "labiale_superius", "labiale_inferius", "stomion", "gnathion",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Anatomy:
    """Holds the few points of a head from which hair, paint and clothes are laid out (head frame, mm). ``unit`` is the
    head's size relative to the one for which the layouts were designed."""

    ears: Float[np.ndarray, " 3"]  # middle between the ears' openings
    half_breadth: float
    chin_y: float
    unit: float
    landmarks: Landmarks  # empty where not all that painting needs are known


def anatomy(vertices: Float[np.ndarray, "v 3"], landmarks: Landmarks) -> Anatomy:
    """Finds the anatomy of a head from its landmarks. If they are unknown, it is estimated from the extent of the mesh,
    as for a head of 225 mm from chin to crown."""
    if {"tragion_right", "tragion_left", "gnathion", "glabella"} <= set(landmarks):
        right, left = landmarks["tragion_right"], landmarks["tragion_left"]
        chin = float(landmarks["gnathion"][1])
        unit = float(landmarks["glabella"][1] - chin) / 132.0
        known = landmarks if set(PAINTED) <= set(landmarks) else {}
        return Anatomy((right + left) / 2, float(left[0] - right[0]) / 2, chin, unit, known)
    top = float(np.quantile(vertices[:, 1], 0.9995))
    skull = vertices[vertices[:, 1] > top - 130.0]
    breadth, length = np.ptp(skull[:, 0]), np.ptp(skull[:, 2])
    middle = (skull.min(axis=0) + skull.max(axis=0)) / 2
    ears = np.array([middle[0], top - 130.0, middle[2] - 0.02 * length])
    return Anatomy(ears, 0.46 * float(breadth), top - 225.0, 1.0, {})

"""Lists the 26 landmarks of the paper's section 3.2 by their anthropometric names, and the seven of them that its
section 4.2 uses.

Right and left are the subject's right and left. The definitions follow Farkas, *Anthropometry of the Head and Face*
(1994); docs/models.md explains the landmarks to people who mark scans."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

LANDMARK_NOISE_MM = 2.0  # position of a landmark against the same landmark of another head
MIDLINE = (
    "glabella",  # most forward point between the eyebrows
    "nasion",  # deepest point of the nasal root (sellion)
    "pronasale",  # tip of the nose
    "subnasale",  # where the nasal septum meets the upper lip
    "labiale_superius",  # upper edge of the upper lip
    "stomion",  # where the lips meet
    "labiale_inferius",  # lower edge of the lower lip
    "sublabiale",  # deepest point of the groove between lower lip and chin
    "pogonion",  # most forward point of the chin
    "gnathion",  # lowest point of the chin
)
PAIRED = (
    "exocanthion",  # outer corner of the eye
    "endocanthion",  # inner corner of the eye
    "alare",  # most lateral point of the nasal wing
    "cheilion",  # corner of the mouth
    "tragion",  # notch above the tragus of the ear
    "gonion",  # angle of the lower jaw
    "zygion",  # most lateral point of the cheek bone
    "frontotemporale",  # side of the forehead, above the outer end of the eyebrow
)
NAMES: tuple[str, ...] = MIDLINE + tuple(f"{name}_{side}" for name in PAIRED for side in ("right", "left"))

SEVEN_POINTS = (
    "exocanthion_right",
    "exocanthion_left",
    "pronasale",
    "subnasale",
    "cheilion_right",
    "cheilion_left",
    "gnathion",
)
"""The seven feature points of section 4.2."""


def mirrored(name: str) -> str:
    """Returns the name of the landmark on the other side of the head; a midline landmark keeps its name."""
    if name.endswith("_right"):
        return name.removesuffix("_right") + "_left"
    if name.endswith("_left"):
        return name.removesuffix("_left") + "_right"
    return name


def stacked(points: Mapping[str, Float[np.ndarray, " 3"]], names: Iterable[str] = NAMES) -> Float[np.ndarray, "L 3"]:
    """Returns the positions of the landmarks ``names`` as rows of an array, in that order. Raises KeyError if a
    landmark is missing."""
    return np.array([points[name] for name in names], float).reshape(-1, 3)

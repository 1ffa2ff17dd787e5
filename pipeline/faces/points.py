"""The 468 points of the landmark network: which are each other's mirror image, and the few that others lean on.

``right`` and ``left`` are the subject's. The mirror images were measured: the network was run on faces and on their
mirror images, and each point paired with the one that comes nearest (``python -m tests.support.landmark_map``).
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

RIGHT_EYE_CORNERS, LEFT_EYE_CORNERS = (33, 133), (263, 362)  # outer, inner
NOSE_TIP, CHIN, FOREHEAD = 1, 152, 10
RIGHT_EYE_OUTLINE = (33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173)
"""The edges of a right eye's lids, in the order of the eye's network: along the lower lid from the outer corner to the
inner one, then along the upper lid."""


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """What was measured of the points; arrays are read-only. Face frame: x to the subject's left, y up, z out."""

    mirror_images: Int[np.ndarray, " 468"]  # of each point; those of the midline are their own
    shape_mm: Float[np.ndarray, "468 3"]  # on a mean adult, about the mean of the points
    normals: Float[np.ndarray, "468 3"]  # of the skin there, unit


@cache
def point_table() -> PointTable:
    """Reads the table that ships with the networks."""
    with np.load(Path(__file__).parent / "packs" / "points.npz", allow_pickle=False) as table:
        arrays = (table["mirror_images"].astype(int), table["shape_mm"].astype(float), table["normals"].astype(float))
    for array in arrays:
        array.flags.writeable = False
    return PointTable(*arrays)

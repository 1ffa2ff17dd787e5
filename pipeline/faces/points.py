"""The 468 points of the landmark network: which are each other's mirror image, and the few that others lean on.

``right`` and ``left`` are the subject's. The mirror images were measured: the network was run on faces and on their
mirror images, and each point paired with the one that comes nearest (``python -m tests.support.landmark_map``).
"""

from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Int

RIGHT_EYE_CORNERS, LEFT_EYE_CORNERS = (33, 133), (263, 362)  # outer, inner
NOSE_TIP, CHIN, FOREHEAD = 1, 152, 10
RIGHT_EYE_OUTLINE = (33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173)
"""The edges of a right eye's lids, in the order of the eye's network: along the lower lid from the outer corner to the
inner one, then along the upper lid."""

_TABLE = Path(__file__).parent / "packs" / "points.npz"


@cache
def mirror_images() -> Int[np.ndarray, " 468"]:
    """For each point its mirror image; those of the midline are their own."""
    with np.load(_TABLE, allow_pickle=False) as table:
        pairs = table["mirror_images"].astype(int)
    pairs.flags.writeable = False
    return pairs

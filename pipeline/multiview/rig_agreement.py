"""Are these the cameras that took the pictures? Asked of the silhouettes and the calibration, before the fit.

Where most cameras contradict the others, other readings are tried: all pictures reflected about their principal points,
as a mirrored rig would see them; flipped, as some cameras deliver them; turned by 180 degrees, or by 90 where they are
square. The reading under which tangent planes touch both outlines of each pair is named. Where there is none, the
calibration is another rig's, or of this one before it was rearranged.

Enters: silhouettes and the rig. Leaves: what is wrong and what to do, or nothing.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.camera_assignment import INSET_PX, mean_misfit, own_misses, with_masks
from pipeline.multiview.tangency import outer_hull
from rig.camera import Intrinsics
from rig.rig import Rig

CAMERAS_LEAST = 4  # three have six planes at most: too few to refuse a capture by
PLANES_LEAST = 4  # of a camera whose word counts
WRONG_LEAST = 0.35  # median over the cameras of their mean misfit: 0.07 in a good capture, 0.62 and more in other rigs
RIGHT_MOST = 0.25  # of a reading that is believed

Pixels = Float[np.ndarray, "_ 2"]
Turn = Callable[[Pixels, Intrinsics], Pixels]


def wrong_rig(silhouettes: Mapping[str, Silhouette], rig: Rig) -> str | None:
    """What is wrong with cameras and pictures as wholes, with the remedy; None where most cameras agree.

    Args:
        silhouettes: by camera; views without a usable mask are left out of the question.
        rig: the cameras as calibrated.
    """
    seen = with_masks({name: s for name, s in silhouettes.items() if s.quality.usable}, rig)
    if len(seen) < CAMERAS_LEAST:
        return None
    hulls = [outer_hull(silhouettes[camera.name], INSET_PX) for camera in seen]
    if _median_misfit(hulls, seen) < WRONG_LEAST:
        return None
    square = all(camera.intrinsics.width == camera.intrinsics.height for camera in seen)
    readings = (*_READINGS, *(_SQUARE_READINGS if square else ()))
    misfits = [_median_misfit(_read(hulls, seen, turn), seen) for _, turn in readings]
    best = int(np.argmin(misfits))
    return readings[best][0] if misfits[best] <= RIGHT_MOST else OTHER_RIG


def _median_misfit(hulls: Sequence[Pixels], rig: Rig) -> float:
    """Median over the cameras of the mean robust misfit of their planes (0 to 1); 0 where too few planes speak."""
    misses = own_misses(hulls, rig)
    speaking = np.isfinite(misses).sum(axis=(1, 2)) >= PLANES_LEAST
    return float(np.median(mean_misfit(misses)[speaking])) if speaking.sum() >= CAMERAS_LEAST else 0.0


def _read(hulls: Sequence[Pixels], rig: Rig, turn: Turn) -> list[Pixels]:
    return [turn(hull, camera.intrinsics) for hull, camera in zip(hulls, rig, strict=True)]


def _flipped_across(pixels: Pixels, k: Intrinsics) -> Pixels:
    return np.stack([k.width - 1.0 - pixels[:, 0], pixels[:, 1]], axis=1)


def _mirrored_across(pixels: Pixels, k: Intrinsics) -> Pixels:
    return np.stack([2.0 * k.cx - pixels[:, 0], pixels[:, 1]], axis=1)


def _mirrored_down(pixels: Pixels, k: Intrinsics) -> Pixels:
    return np.stack([pixels[:, 0], 2.0 * k.cy - pixels[:, 1]], axis=1)


def _turned_round(pixels: Pixels, k: Intrinsics) -> Pixels:
    return (k.width - 1.0, k.height - 1.0) - pixels


def _turned_back(pixels: Pixels, k: Intrinsics) -> Pixels:
    """By 90 degrees clockwise."""
    return np.stack([k.height - 1.0 - pixels[:, 1], pixels[:, 0]], axis=1)


def _turned_on(pixels: Pixels, k: Intrinsics) -> Pixels:
    """By 90 degrees anticlockwise."""
    return np.stack([pixels[:, 1], k.width - 1.0 - pixels[:, 0]], axis=1)


OTHER_RIG = (
    "the outlines contradict these cameras, whichever picture belongs to whom and however they are turned: "
    "cameras.json is of another rig, or of this one before it was rearranged; give this rig's own, or calibrate it "
    "again"
)
_MIRRORED = (
    "the rig is mirrored: the outlines agree once its poses are reflected. cameras.json was written in a left-handed "
    "world or with one axis negated; write it right-handed (x right, y down, z forward in each camera)"
)
_FLIPPED = (
    "the pictures are flipped left to right against the calibration: the outlines agree once they are flipped back; "
    "switch the mirror image off in the cameras"
)
_TURNED = (
    "the pictures are turned by {} against the calibration: the outlines agree once they are turned back; turn them, "
    "or calibrate with pictures that are turned alike"
)
_READINGS: tuple[tuple[str, Turn], ...] = (
    (_MIRRORED, _mirrored_across),
    (_MIRRORED, _mirrored_down),
    (_FLIPPED, _flipped_across),
    (_TURNED.format("180 degrees"), _turned_round),
)
_SQUARE_READINGS: tuple[tuple[str, Turn], ...] = (
    (_TURNED.format("90 degrees anticlockwise"), _turned_back),
    (_TURNED.format("90 degrees clockwise"), _turned_on),
)

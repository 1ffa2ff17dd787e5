"""Does somebody sit in the studio while its clean plates are taken?

One who holds still moves nothing between the plates, so that only the plates before can tell: in most pictures one
region is another, and the rest is as it was. A chair that was put there looks the same, and a lamp that was turned may;
what is still there, unmoved, when plates are taken once more belongs to the studio. Pure functions of images.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

ImageRgb = UInt8[np.ndarray, "_ _ 3"]  # cameras differ in size

BLOCK_PX = 16
CHANGED_LEVELS, CHANGED_LOG = 10.0, 0.12  # of a block's mean: by both, light of the whole picture taken off
REGION_LEAST = 0.04  # of the picture: a head and shoulders take a tenth to a half of it
REST_LEAST = 0.25  # of the picture is as before, or the studio was rebuilt
CAMERAS_SHARE = 0.5


def occupied(fresh: Mapping[str, ImageRgb], before: Mapping[str, ImageRgb]) -> tuple[str, ...]:
    """Cameras whose picture of the empty studio holds what the plate before it does not; none unless half of those
    that can be compared agree."""
    asked = [name for name in fresh if name in before and fresh[name].shape == before[name].shape]
    found = tuple(name for name in asked if _region_share(fresh[name], before[name]) >= REGION_LEAST)
    return found if len(found) >= max(2, CAMERAS_SHARE * len(asked)) else ()


def _region_share(fresh: ImageRgb, before: ImageRgb) -> float:
    """Share of the picture in the largest region that changed; 0 where hardly anything is as it was."""
    changed = _changed(fresh, before)
    if 1.0 - changed.mean() < REST_LEAST:
        return 0.0
    count, _, stats, _ = cv2.connectedComponentsWithStats(changed.astype(np.uint8), connectivity=8)
    return float(stats[1:, cv2.CC_STAT_AREA].max() / changed.size) if count > 1 else 0.0


def _changed(fresh: ImageRgb, before: ImageRgb) -> Bool[np.ndarray, "r c"]:
    """Blocks of BLOCK_PX whose mean is another, by level and by ratio, in any channel."""
    size = max(1, fresh.shape[1] // BLOCK_PX), max(1, fresh.shape[0] // BLOCK_PX)
    now, then = (cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) for image in (fresh, before))
    ratio = np.log((now + 1.0) / (then + 1.0))
    light = np.median(ratio, axis=(0, 1))
    levels = np.abs(now - np.exp(light) * then)
    return ((levels > CHANGED_LEVELS) & (np.abs(ratio - light) > CHANGED_LOG)).any(axis=2)

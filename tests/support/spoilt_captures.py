"""Spoils captures: masks with a wrong contour, dilated masks, cameras that were knocked or that show a part."""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from rig.camera import Camera
from rig.geometry import RigidTransform, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.hair import HairStyle
from tests.support.changed_rigs import reposed

OVER_EARS = HairStyle(thickness_mm=18.0, over_ears=True)
WRONG_SHARE, WRONG_RADII_PX = 0.2, (6.0, 18.0)
LOOSE_PX = 2
CLOSE_UP, CLOSE_UP_SHARE = 2.0, 0.3  # focal length; of the height: how far down the head is, so that its crown is whole


def spoiled(mask: Bool[np.ndarray, "h w"], rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Returns the mask with disks added or cut out until ``WRONG_SHARE`` of its contour is wrong."""
    edge = mask & ~_eroded(mask)
    at = np.argwhere(edge)
    wrong, out = np.zeros(len(at), bool), mask.copy()
    rows, columns = np.ogrid[: mask.shape[0], : mask.shape[1]]
    while wrong.mean() < WRONG_SHARE:
        y, x = at[rng.integers(len(at))]
        radius = rng.uniform(*WRONG_RADII_PX)
        out[(rows - y) ** 2 + (columns - x) ** 2 < radius**2] = bool(rng.integers(2))
        wrong |= ((at - (y, x)) ** 2).sum(axis=1) < radius**2
    return out


def _eroded(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    inner = mask.copy()
    for axis in (0, 1):
        for step in (1, -1):
            inner &= np.roll(mask, step, axis)
    return inner


def knocked(rig: Rig, name: str, turn_deg: float, rng: np.random.Generator) -> Rig:
    """Returns the rig with one camera turned about a random axis across its view."""
    around = rng.uniform(0.0, 2.0 * np.pi)
    turn = np.radians(turn_deg) * np.array([np.cos(around), np.sin(around), 0.0])
    motion = RigidTransform(rotation_from_vector(turn), np.zeros(3))
    return reposed(rig, lambda pose: motion @ pose, name)


def loosened(silhouettes: Mapping[str, Silhouette]) -> dict[str, Silhouette]:
    """Returns silhouettes whose masks are dilated by ``LOOSE_PX``."""
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * LOOSE_PX + 1, 2 * LOOSE_PX + 1))
    masks = {name: cv2.dilate(s.mask.view(np.uint8), disk).view(bool) for name, s in silhouettes.items()}
    return {name: silhouette_from_mask(mask) for name, mask in masks.items()}


def close_up(camera: Camera) -> Camera:
    """Returns the camera with a lens of ``CLOSE_UP`` times the focal length, aimed higher."""
    k = camera.intrinsics
    down = k.cy + CLOSE_UP_SHARE * k.height
    return replace(camera, intrinsics=replace(k, fx=CLOSE_UP * k.fx, fy=CLOSE_UP * k.fy, cy=down))

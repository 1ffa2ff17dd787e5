"""Checks the size of the head that the outlines show, before a fit, from silhouettes and cameras alone.

Cameras from another program have an arbitrary unit if no length was given. A model fitted to a head three times too
large lies inside the face, and every outline counts as clutter. Each outline has a diameter that needs no model: going
down from the crown, an outline is wider than twice the distance from the crown until it is as wide as a round head's
diameter. At the distance of the subject that is 150 to 290 mm for people, hair included.

Enters: silhouettes and the rig. Leaves: the diameter, and the message about it.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.imaging.silhouette import Silhouette
from pipeline.warnings import ReportWarning
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.messages.message import Message, compose
from rig.rig import Rig

HEAD_MM = 200.0  # median diameter of 32 heads with hair, 18 captures of the studio and 5 of a path tracer (174 to 230)
WARNED_MM = (145.0, 270.0)  # bald heads of adults have 161 and more, hair 40 mm thick 245 at most
REFUSED_MM = (122.0, 350.0)  # a bald child of three has 130, hair 60 mm thick 310 at most; twice a bald head has 322
STRAND_SHARE = 0.06  # of a mask's size (root of its area): a centimetre of a head, which loose strands do not fill
MIN_VIEWS = 3  # whose crown is in the picture


def head_diameter_mm(silhouettes: Mapping[str, Silhouette], rig: Rig) -> float | None:
    """Returns the median over the views of the head's diameter (mm); None if too few views show the crown.

    Args:
        silhouettes: by camera; unusable ones are ignored.
        rig: the cameras as calibrated.
    """
    seen: list[tuple[Camera, Float[np.ndarray, " 2"], float]] = []
    for camera in rig:
        silhouette = silhouettes.get(camera.name)
        if silhouette is None or not silhouette.quality.usable:
            continue
        crown = crown_disc(silhouette.mask)
        if crown is not None:
            seen.append((camera, *crown))
    if len(seen) < MIN_VIEWS:
        return None
    middle = _crossing([camera for camera, _, _ in seen], np.array([pixel for _, pixel, _ in seen]))
    depths = np.array([float(camera.camera_from_world.apply(middle)[2]) for camera, _, _ in seen])
    focal = np.array([camera.intrinsics.fx for camera, _, _ in seen])
    diameters = np.array([diameter for _, _, diameter in seen]) * depths / focal
    ahead = diameters[depths > 0]
    return float(np.median(ahead)) if len(ahead) >= MIN_VIEWS else None


class WrongScale(EigenheadError):
    """Reports outlines of a size that no head has, so that the cameras are probably not in millimetres."""

    def __init__(self, diameter_mm: float, *, masks_given: bool = False) -> None:
        part = masks_given and diameter_mm < HEAD_MM
        remedy = compose("advice-whole-masks") if part else compose("advice-known-length")
        super().__init__(compose("size-refused", size=_size_message(diameter_mm), remedy=remedy))


def judge_head_size(
    silhouettes: Mapping[str, Silhouette], rig: Rig, *, masks_given: bool = False
) -> list[ReportWarning]:
    """Returns a warning if the outlined head is unusually large or small. Raises WrongScale if its size is impossible.
    With ``masks_given``, the masks are the operator's and may show only a part of the head."""
    diameter = head_diameter_mm(silhouettes, rig)
    if diameter is None:
        return []
    if not REFUSED_MM[0] < diameter < REFUSED_MM[1]:
        raise WrongScale(diameter, masks_given=masks_given)
    if not WARNED_MM[0] < diameter < WARNED_MM[1]:
        return [compose("scale-implausible", finding=_outline_size(diameter))]
    return []


def _outline_size(diameter_mm: float) -> Message:
    unless = compose("much-hair") if diameter_mm > HEAD_MM else compose("small-child")
    remedy = compose("advice-known-length")
    return compose("outline-size", size=_size_message(diameter_mm), unless=unless, remedy=remedy)


def _size_message(diameter_mm: float) -> Message:
    factor = diameter_mm / HEAD_MM
    ratio = f"{factor:.1f}" if factor >= 0.95 else f"{factor:.2f}"
    return compose("head-times-as-large", ratio=ratio, diameter_mm=diameter_mm)


def crown_disc(mask: Bool[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, " 2"], float] | None:
    """Returns the middle (px) and diameter (px) of the head in a mask; None if its crown is not inside the picture."""
    turns = _turns_to_upright(mask)
    upright = np.rot90(_without_strands(mask), turns)
    rows = np.flatnonzero(upright.any(axis=1))
    if not len(rows) or rows[0] == 0:
        return None
    part = upright[rows[0] :]
    columns = np.arange(part.shape[1])
    count = part.sum(axis=1)
    first = np.where(part.any(axis=1), part.argmax(axis=1), 0)
    last = np.where(part.any(axis=1), part.shape[1] - 1 - part[:, ::-1].argmax(axis=1), -1)
    width = np.where(count > 0, last - first + 1, 0)
    way = np.arange(len(width)) + 0.5
    beyond = np.flatnonzero((width < 2.0 * way) & (way > 2.0))
    if not len(beyond):
        return None
    row = int(beyond[0])
    x, y = columns[[first[row], last[row]]].mean(), rows[0] + row
    height, wide = upright.shape
    place = {0: (x, y), 1: (mask.shape[1] - 1 - y, x), 2: (wide - 1 - x, height - 1 - y), 3: (y, mask.shape[0] - 1 - x)}
    return np.array(place[turns], float), 2.0 * float(way[row])


def _without_strands(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Returns the mask without parts thinner than ``STRAND_SHARE`` of its size."""
    side = max(3, 2 * round(STRAND_SHARE * float(np.sqrt(mask.sum())) / 2) + 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc).view(bool)


def _turns_to_upright(mask: Bool[np.ndarray, "h w"]) -> int:
    """Returns the number of quarter turns (anticlockwise) after which the body leaves the picture through the
    bottom."""
    touched = [mask[-1].sum(), mask[:, 0].sum(), mask[0].sum(), mask[:, -1].sum()]  # bottom, left, top, right
    return int(np.argmax(touched)) if max(touched) else 0


def _crossing(cameras: list[Camera], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " 3"]:
    """Returns the point (world, mm) nearest to the rays through one pixel of each camera, by least squares."""
    normal, right = 1e-9 * np.eye(3), np.zeros(3)
    for camera, pixel in zip(cameras, pixels, strict=True):
        ray = camera.rays_world(pixel[None])[0]
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ camera.centre_world
    return np.linalg.solve(normal, right)

"""Checks the size of the head in the silhouettes before a fit, and whether the crown has the same height in every view.

Cameras from another program have an arbitrary unit if no known length was supplied. If the outlines are three times too
large, a fitted model lies inside the face, and every outline is treated as clutter. The head's diameter is measured
without a model: at the distance d below the crown at which the outline is 2 d wide, the diameter is 2 d. The head's
diameter is 150 to 290 mm for people, hair included.

The face gives the upward direction. Without a face the pictures or the rig give it, whichever makes more outlines
consistent with the same head. Nothing is refused if the photographs show a face of a human's size.

A crown is nearly round, so planes through each camera that touch it from above have nearly the same distance from the
skull's middle. If a mask ends below the crown, its plane passes nearer.
"""

from collections.abc import Callable, Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.upright import guessed_up
from pipeline.view_checks.guards import STRICT, FaceEvidence, Guards
from pipeline.warnings import ReportWarning
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.messages.message import Message, compose
from rig.rig import Rig

Vector = Float[np.ndarray, " 3"]
Mask = Bool[np.ndarray, "h w"]

HEAD_MM = 200.0  # median diameter of 32 heads with hair, 18 captures of the studio and 5 of a path tracer (174 to 230)
WARNED_MM = (145.0, 270.0)  # bald heads of adults have 161 and more, hair 40 mm thick 245 at most
REFUSED_MM = (122.0, 350.0)  # a bald child of three has 130, hair 60 mm thick 310 at most; twice a bald head has 322
STRAND_SHARE = 0.06  # of a mask's size (root of its area): a centimetre of a head, which loose strands do not fill
MIN_VIEWS = 3  # whose crown is in the picture
MIN_MEETING = 0.5  # of these views: where most do not meet in one head, they measure none

BESIDE_MM = 110.0  # from the middle of the head: what is farther is a hand or a shoulder
SKULL_MM = (0.0, 60.0, -90.0)  # the skull's middle from the face's: leftwards, up, ahead; crowns of 8 captures
MAX_LOW_MM = 18.0  # below the others; 12 in whole masks of 8 captures, long hair among them

Discs = Mapping[str, tuple[Float[np.ndarray, " 2"], float]]  # by camera: middle and diameter (px)


def head_diameter_mm(silhouettes: Mapping[str, Silhouette], rig: Rig, face: FaceEvidence | None = None) -> float | None:
    """Returns the median of the head's diameter (mm) over the views with consistent outlines; None if these views are
    too few, or fewer than half of all.

    Args:
        silhouettes: by camera; unusable ones are ignored.
        rig: the cameras as calibrated.
        face: gives the upward direction and the head's position, if it is known.
    """
    solid = {
        name: _without_strands(silhouettes[name].mask)
        for name in rig.names
        if name in silhouettes and silhouettes[name].quality.usable
    }
    pictures_up = -np.mean([camera.camera_from_world.rotation[1] for camera in rig], axis=0)
    ups = (pictures_up, guessed_up(rig)) if face is None else (face.up_world,)
    diameters = max((_diameters_mm(solid, rig, up, face) for up in ups), key=len)
    return float(np.median(diameters)) if len(diameters) >= MIN_VIEWS else None


def _diameters_mm(
    solid: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig, up_world: Vector, face: FaceEvidence | None
) -> list[float]:
    """Returns the head's diameter (mm) in each view whose outline lies at the head's position in the other views or at
    the face. Returns no diameter if these views are less than ``MIN_MEETING`` of the views that show a crown."""
    found = {name: crown_disc(mask, turns_to_upright(rig[name], up_world)) for name, mask in solid.items()}
    discs = {name: disc for name, disc in found.items() if disc is not None}
    point = _middle(discs, rig) if face is None else face.centre_world
    if point is None or not discs:
        return []
    on = dict(zip(discs, _on_discs(point[None], discs, rig)[0], strict=True))
    meeting = [name for name in discs if on[name]]
    if len(meeting) < MIN_MEETING * len(discs):
        return []
    return [discs[name][1] * _mm_per_px(rig[name], point) for name in meeting]


def find_low_crowns(
    silhouettes: Mapping[str, Silhouette], rig: Rig, find_face: Callable[[], FaceEvidence | None]
) -> dict[str, float]:
    """Returns how far (mm) the crown in a view lies below the crown of the other views, for views with more than
    ``MAX_LOW_MM``. The face is searched only if the outlines are suspicious."""
    solid = {name: _without_strands(s.mask) for name, s in silhouettes.items() if s.quality.usable and name in rig}
    pictures_up = -np.mean([camera.camera_from_world.rotation[1] for camera in rig], axis=0)
    found = {name: crown_disc(mask, turns_to_upright(rig[name], pictures_up)) for name, mask in solid.items()}
    middle = _middle({name: disc for name, disc in found.items() if disc is not None}, rig)
    if middle is not None and not _low_crowns(solid, rig, middle, pictures_up / np.linalg.norm(pictures_up)):
        return {}
    face = find_face()
    return {} if face is None else _low_crowns(solid, rig, face.skull_world(SKULL_MM), face.up_world)


def _low_crowns(
    solid: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig, middle_world: Vector, up_world: Vector
) -> dict[str, float]:
    heights = {name: crown_height_mm(mask, rig[name], middle_world, up_world) for name, mask in solid.items()}
    known = {name: height for name, height in heights.items() if height is not None}
    if len(known) < MIN_VIEWS:
        return {}
    others = {name: float(np.median([known[other] for other in known if other != name])) for name in known}
    return {name: others[name] - known[name] for name in known if others[name] - known[name] > MAX_LOW_MM}


def crown_height_mm(mask: Mask, camera: Camera, middle_world: Vector, up_world: np.ndarray) -> float | None:
    """Returns the distance (mm) from the middle of the skull to the plane through the camera that touches the mask from
    above. Returns None if the mask is empty or its top is at the picture's border."""
    middle, above = camera.project(np.stack([middle_world, middle_world + 50.0 * up_world]))
    up = (above - middle) / np.linalg.norm(above - middle)
    across = np.array([-up[1], up[0]])
    rows, columns = np.nonzero(mask)
    pixels = np.stack([columns, rows], axis=1) - middle
    near = np.abs(pixels @ across) < BESIDE_MM / _mm_per_px(camera, middle_world)
    if not near.any():
        return None
    pixels = pixels[near]
    top = pixels[int(np.argmax(pixels @ up))] + middle
    limit = np.array([mask.shape[1], mask.shape[0]]) - 2.0
    if (top < 1.0).any() or (top > limit).any():
        return None
    ends = camera.rays_world(np.stack([top + 20.0 * across, top - 20.0 * across]))
    normal = np.cross(ends[0], ends[1])
    normal *= np.sign(normal @ up_world) / np.linalg.norm(normal)
    return float(normal @ (camera.centre_world - middle_world))


def _mm_per_px(camera: Camera, point_world: Vector) -> float:
    """Returns the width (mm) of a pixel at the distance of a point."""
    return float(camera.camera_from_world.apply(point_world)[2]) / camera.intrinsics.fx


class WrongScale(EigenheadError):
    """Reports outlines of an impossible size; the cameras are probably not in millimetres."""

    def __init__(self, diameter_mm: float, *, masks_given: bool = False) -> None:
        part = masks_given and diameter_mm < HEAD_MM
        remedy = compose("advice-whole-masks") if part else compose("advice-known-length")
        super().__init__(compose("size-refused", size=_size_message(diameter_mm), remedy=remedy))


def judge_head_size(
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    find_face: Callable[[], FaceEvidence | None] = lambda: None,
    *,
    guards: Guards = STRICT,
    masks_given: bool = False,
) -> list[ReportWarning]:
    """Returns a warning if the head is unusually large or small. Refuses with WrongScale if the head's size is
    impossible, unless a face of a human's size was found.

    Args:
        silhouettes: by camera; unusable ones are ignored.
        rig: the cameras as calibrated.
        find_face: finds the subject's face; called only if the outlines are suspicious.
        guards: decides about refusals.
        masks_given: whether the masks are the operator's and may show only a part of the head.
    """
    diameter = head_diameter_mm(silhouettes, rig)
    if diameter is None or WARNED_MM[0] < diameter < WARNED_MM[1]:
        return []
    face = find_face()
    if face is not None:
        diameter = head_diameter_mm(silhouettes, rig, face)
        if diameter is None or WARNED_MM[0] < diameter < WARNED_MM[1]:
            return []
    if REFUSED_MM[0] < diameter < REFUSED_MM[1]:
        return [compose("scale-implausible", finding=_outline_size(diameter))]
    if face is None:
        return [guards.refuse(WrongScale(diameter, masks_given=masks_given))]
    return [compose("scale-implausible", finding=compose("outline-size-but-face", size=_size_message(diameter)))]


def _outline_size(diameter_mm: float) -> Message:
    unless = compose("much-hair") if diameter_mm > HEAD_MM else compose("small-child")
    remedy = compose("advice-known-length")
    return compose("outline-size", size=_size_message(diameter_mm), unless=unless, remedy=remedy)


def _size_message(diameter_mm: float) -> Message:
    factor = diameter_mm / HEAD_MM
    ratio = f"{factor:.1f}" if factor >= 0.95 else f"{factor:.2f}"
    return compose("head-times-as-large", ratio=ratio, diameter_mm=diameter_mm)


def crown_disc(mask: Mask, turns: int) -> tuple[Float[np.ndarray, " 2"], float] | None:
    """Returns the middle (px) and diameter (px) of the head in a mask that ``turns`` quarter turns (anticlockwise) make
    upright; None if its crown lies outside the picture."""
    upright = np.rot90(mask, turns)
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


def _without_strands(mask: Mask) -> Mask:
    """Returns the mask without parts thinner than ``STRAND_SHARE`` of its size."""
    side = max(3, 2 * round(STRAND_SHARE * float(np.sqrt(mask.sum())) / 2) + 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc).view(bool)


def turns_to_upright(camera: Camera, up_world: Vector) -> int:
    """Returns the number of quarter turns (anticlockwise) that make the camera's picture upright."""
    right, down = (camera.camera_from_world.rotation @ up_world)[:2]
    return int(np.argmax([-down, right, down, -right]))  # up is at the top, right, bottom and left


def _middle(discs: Discs, rig: Rig) -> Vector | None:
    """Returns the point (world frame) that projects into most of the head's discs. Candidates are points where the rays
    of two views nearly meet; the best is refined by least squares over all discs that contain it."""
    if len(discs) < MIN_VIEWS:
        return None
    cameras = [rig[name] for name in discs]
    rays = np.stack([c.rays_world(disc[0][None])[0] for c, disc in zip(cameras, discs.values(), strict=True)])
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    right = np.einsum("nij,nj->ni", across, np.stack([camera.centre_world for camera in cameras]))
    one, other = np.triu_indices(len(cameras), 1)
    crossings = np.linalg.solve(across[one] + across[other] + 1e-9 * np.eye(3), (right[one] + right[other])[..., None])
    meeting = _on_discs(crossings[..., 0], discs, rig)
    best = meeting[int(np.argmax(meeting.sum(axis=1)))]
    return np.linalg.solve(across[best].sum(axis=0), right[best].sum(axis=0)) if best.sum() >= MIN_VIEWS else None


def _on_discs(points: Float[np.ndarray, "n 3"], discs: Discs, rig: Rig) -> Bool[np.ndarray, "n v"]:
    """Returns, for each point and camera, whether the point lies in front of the camera and projects into its disc."""
    on = []
    for name, (middle, diameter) in discs.items():
        off = np.linalg.norm(rig[name].project(points) - middle, axis=1)  # NaN behind a camera, which is not less
        on.append(off < diameter / 2)
    return np.stack(on, axis=1)

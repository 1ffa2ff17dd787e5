"""Decides on every view of a capture that has neither plates nor masks: what the subject is, and how its edge is found.

Matting must know the background behind the subject's border. In front of a studio's backdrop it is guessed well from
what is beside the subject. In front of clutter, or if the subject stands on something of its own colour, it is not, and
the view is cut along its edges instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.multiview.scene_points import ScenePoints, find_scene_points
from pipeline.segmentation.background import COARSE_COLUMNS, coarse_size
from pipeline.segmentation.foreground import Decision
from pipeline.segmentation.without_plates.estimated_plate import decision_without_plate, plate_noise
from pipeline.segmentation.without_plates.head_seed import HeadSeed, head_core
from pipeline.segmentation.without_plates.local_cut import COLUMNS, cut_views
from pipeline.segmentation.without_plates.mask_search import search_masks
from pipeline.segmentation.without_plates.standing_plane import NEAR, ball_above, standing_plane
from pipeline.segmentation.without_plates.viewing_volume import ViewingVolume, viewing_ball, viewing_volume
from rig.rig import Rig

POINTS_SHARE, MASKS_SHARE = 0.3, 0.6  # of the time, when they are there
POINT_PX = 2  # of the reduced image: what is around a point is the same thing
MIN_LEVEL = 0.8  # cosine between a table's normal and the face's up: a nod of 35 degrees
MAX_PLATE_NOISE = 8.0  # levels by which the guess of a plate may be off; 2 to 4 before the studio's backdrops
ALPHA_BLUR_PX = 1.0  # of the image that was cut


@dataclass(frozen=True, slots=True, eq=False)
class WithoutPlates:
    """Holds the views in two groups, by how their outline is found: ``decisions`` go to the matting; ``shares`` are the
    subject's share of each pixel (full size), for views that were cut along edges."""

    decisions: Mapping[str, Decision]
    shares: Mapping[str, Float32[np.ndarray, "_ _"]]


def decide_without_plates(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    rig: Rig,
    *,
    head: HeadSeed | None = None,
    report: Callable[[float], None] = lambda share: None,
) -> WithoutPlates:
    """Decides which pixels of every photograph show the subject, without plates. ``head`` is the head's position; None
    if no face was found."""
    small = {name: _reduced(images[name], COARSE_COLUMNS).astype(np.float32) for name in rig.names}
    sizes = {name: image.shape[:2] for name, image in small.items()}
    points = find_scene_points(images, rig, report=partial(_between, report, 0.0, POINTS_SHARE))
    ball = viewing_ball(rig, None if head is None else head.centre_world)
    plane = standing_plane(points.points, *ball)
    if plane is not None and head is not None and plane[:3] @ head.up_world < MIN_LEVEL:
        plane = None  # a patterned shirt is as flat as a table, but upright
    if plane is not None:
        ball = ball_above(plane, points.points, *ball)
    volume = viewing_volume(rig, sizes, ball, plane_world=plane)
    background = {
        camera.name: background_seen(points, camera.name, camera.intrinsics.width, sizes[camera.name], volume, plane)
        for camera in rig
    }
    report_masks = partial(_between, report, POINTS_SHARE, MASKS_SHARE)
    found = search_masks(small, rig, volume, background, bounded=plane is not None, head=head, report=report_masks)
    decisions = {
        name: decision_without_plate(images[name], small[name], found[name], solid=head is not None)
        for name in rig.names
    }
    cluttered = {n for n, one in decisions.items() if plane is not None or plate_noise(one) > MAX_PLATE_NOISE}
    if not cluttered:
        return WithoutPlates(decisions, {})
    report_cuts = partial(_between, report, MASKS_SHARE, 1.0)
    reduced = {name: _reduced(images[name], COLUMNS) for name in rig.names}
    cuts = cut_views(reduced, {name: one.mask for name, one in found.items()}, volume, report=report_cuts)
    if head is not None:
        cuts = {name: solid_around(head_core(head, rig[name], cut.shape), cut) for name, cut in cuts.items()}
    shares = {name: _enlarged(cuts[name], images[name].shape[:2]) for name in rig.names if name in cluttered}
    return WithoutPlates({name: one for name, one in decisions.items() if name not in cluttered}, shares)


def background_seen(
    points: ScenePoints,
    name: str,
    width: int,
    size: tuple[int, int],
    volume: ViewingVolume,
    plane: Float[np.ndarray, " 4"] | None,
) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels of a reduced image (``size``: height, width) around scene points that are background: far from
    the subject, or on the plane that it stands on."""
    seen_points = points.points[points.rows[name]]
    behind = np.linalg.norm(seen_points - volume.centre_world, axis=1) > volume.radius_mm
    if plane is not None:
        behind |= seen_points @ plane[:3] + plane[3] < NEAR * volume.radius_mm
    mask = np.zeros(size, np.uint8)
    for x, y in (points.pixels[name][behind] + 0.5) * (size[1] / width):
        cv2.circle(mask, (int(x), int(y)), POINT_PX, 1, -1)
    return mask.view(bool)


def solid_around(core: Bool[np.ndarray, "h w"], share: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Returns the share of a person's cut, of which the head's ``core`` is part and that has no holes: a cut takes a
    highlight on a forehead for the wall."""
    subject = np.pad(((share > 0.5) | core).view(np.uint8), 1)
    cv2.floodFill(subject, None, (0, 0), 2)
    return np.where(core | ((subject[1:-1, 1:-1] == 0) & (share <= 0.5)), np.float32(1.0), share)


def _reduced(image: UInt8[np.ndarray, "_ _ 3"], columns: int) -> UInt8[np.ndarray, "_ _ 3"]:
    return cv2.resize(image, coarse_size(image.shape, columns), interpolation=cv2.INTER_AREA)


def _enlarged(share: Float32[np.ndarray, "_ _"], size: tuple[int, ...]) -> Float32[np.ndarray, "_ _"]:
    smooth = cv2.GaussianBlur(share, (0, 0), ALPHA_BLUR_PX)
    return cv2.resize(smooth, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)


def _between(report: Callable[[float], None], start: float, end: float, share: float) -> None:
    report(start + (end - start) * share)

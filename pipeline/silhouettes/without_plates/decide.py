"""Decisions for every view of a capture that has neither plates nor masks."""

from collections.abc import Callable, Mapping
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.multiview.scene_points import ScenePoints, find_scene_points
from pipeline.settings import SegmentationSettings
from pipeline.silhouettes.background import coarse_size
from pipeline.silhouettes.foreground import Decision
from pipeline.silhouettes.without_plates.estimated_plate import decision_without_plate
from pipeline.silhouettes.without_plates.mask_search import search_masks
from pipeline.silhouettes.without_plates.standing_plane import NEAR, ball_above, standing_plane
from pipeline.silhouettes.without_plates.viewing_volume import ViewingVolume, viewing_ball, viewing_volume
from rig.rig import Rig

POINTS_SHARE = 0.4  # of the time
POINT_PX = 2  # of the reduced image: what is around a point is the same thing


def decide_without_plates(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    rig: Rig,
    settings: SegmentationSettings,
    *,
    report: Callable[[float], None] = lambda share: None,
) -> dict[str, Decision]:
    """What is subject in every photograph: ``pipeline.silhouettes.matting`` finds the contour from it."""
    small = {
        name: cv2.resize(
            images[name], coarse_size(images[name].shape, settings.coarse_columns), interpolation=cv2.INTER_AREA
        ).astype(np.float32)
        for name in rig.names
    }
    points = find_scene_points(images, rig, report=lambda share: report(POINTS_SHARE * share))
    sizes = {name: image.shape[:2] for name, image in small.items()}
    ball = viewing_ball(rig)
    plane = standing_plane(points.points, *ball)
    if plane is not None:
        ball = ball_above(plane, points.points, *ball)
    volume = viewing_volume(rig, sizes, ball, plane_world=plane)
    background = {
        camera.name: background_seen(points, camera.name, camera.intrinsics.width, sizes[camera.name], volume, plane)
        for camera in rig
    }
    told = partial(_from, report, POINTS_SHARE)
    found = search_masks(small, rig, volume, background, bounded=plane is not None, report=told)
    return {name: decision_without_plate(images[name], small[name], found[name], settings) for name in rig.names}


def _from(report: Callable[[float], None], start: float, share: float) -> None:
    report(start + (1 - start) * share)


def background_seen(
    points: ScenePoints,
    name: str,
    width: int,
    size: tuple[int, int],
    volume: ViewingVolume,
    plane: Float[np.ndarray, " 4"] | None,
) -> Bool[np.ndarray, "h w"]:
    """Reduced pixels (``size``: height, width) around points that are far from all subjects or on what it stands on."""
    own = points.points[points.rows[name]]
    behind = np.linalg.norm(own - volume.centre_world, axis=1) > volume.radius_mm
    if plane is not None:
        behind |= own @ plane[:3] + plane[3] < NEAR * volume.radius_mm
    mask = np.zeros(size, np.uint8)
    for x, y in (points.pixels[name][behind] + 0.5) * (size[1] / width):
        cv2.circle(mask, (int(x), int(y)), POINT_PX, 1, -1)
    return mask.view(bool)

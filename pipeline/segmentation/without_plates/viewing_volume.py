"""Divides the space around the subject into voxels, and combines the log odds of other views along each pixel's ray.

As in the visual hull (the paper's figure 1), a voxel belongs to the subject only if no view that sees it excludes it.
Views are combined by log odds instead of masks (Franco & Boyer, *Fusion of multi-view silhouette cues using a space
occupancy grid*, ICCV 2005), so that an uncertain view has no effect.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from pipeline.multiview.visual_hull import depth_of
from rig.rig import Rig

CELLS = 96  # voxels a side: 7 mm where images show 0.66 m, 2.6 pixels of the reduced images
MAX_DENIES = 4.0  # log odds that one view's word against a voxel is worth: empty space in one view is empty ...
MAX_GRANTS, GRANTS_SUM = 1.0, 10.0  # ... and those for it, of one view and of all, however many they are
MIN_WITNESSES = 3  # other views that must see a voxel before their word counts
WITNESSES_SHARE = 0.5  # of the other views that must hold a voxel for the subject before it must be in a mask
SOLID_ODDS = 0.5  # log odds that all pixels around a voxel must have in a view that holds it for the subject


@dataclass(frozen=True, slots=True, eq=False)
class ViewingVolume:
    """Holds the voxels of a ball around the point to which all cameras are directed, and their pixels in each view."""

    centre_world: Float[np.ndarray, " 3"]
    radius_mm: float
    places: Mapping[str, Int32[np.ndarray, " n"]]  # pixel (flat) of every voxel in a view's reduced image, or -1
    reach_px: Mapping[str, int]  # width of a voxel in the reduced image


@dataclass(frozen=True, slots=True, eq=False)
class OtherViews:
    """Holds the evidence of all other views for each pixel of one view. ``support`` is the largest sum of the other
    views' log odds at a voxel on the pixel's ray (negative if they exclude the subject). ``solid`` is True if no other
    view doubts some voxel on the ray."""

    support: Float32[np.ndarray, "h w"]
    solid: Bool[np.ndarray, "h w"]


def viewing_ball(
    rig: Rig, centre_world: Float[np.ndarray, " 3"] | None = None
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Returns centre (world frame) and radius (mm) of a ball that extends to the corners of the median image.
    ``centre_world`` replaces the centre; None means the point to which the cameras are directed."""
    centre = rig.centre_world() if centre_world is None else centre_world
    radius = float(
        np.median(
            [
                depth_of(camera, centre) / k.fx * 0.5 * np.hypot(k.width, k.height)
                for camera in rig
                for k in (camera.intrinsics,)
            ]
        )
    )
    return centre, radius


def build_volume(
    rig: Rig,
    sizes: Mapping[str, tuple[int, int]],
    ball: tuple[Float[np.ndarray, " 3"], float],
    *,
    plane_world: Float[np.ndarray, " 4"] | None = None,
) -> ViewingVolume:
    """Builds the volume of a ``ball``, centre and radius (mm), for reduced images of ``sizes`` (height, width).
    ``plane_world`` is the plane on which the subject stands; voxels with a negative ``plane . (x, 1)`` are left out."""
    centre, radius = ball
    line = ((np.arange(CELLS) + 0.5) / CELLS * 2 - 1) * radius
    offsets = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = centre + offsets[(offsets**2).sum(axis=1) < radius**2]
    if plane_world is not None:
        voxels = voxels[voxels @ plane_world[:3] + plane_world[3] > radius / CELLS]
    places, reach = {}, {}
    for camera in rig:
        height, width = sizes[camera.name]
        scale = width / camera.intrinsics.width
        at = (camera.project(voxels) + 0.5) * scale
        seen = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)  # NaN, behind the camera, is not
        pixels = np.where(seen[:, None], at, 0).astype(np.int32)
        places[camera.name] = np.where(seen, pixels[:, 1] * width + pixels[:, 0], -1).astype(np.int32)
        voxel_px = 2 * radius / CELLS * camera.intrinsics.fx / depth_of(camera, centre) * scale
        reach[camera.name] = int(np.ceil(voxel_px))
    return ViewingVolume(centre, radius, places, reach)


def reachable(volume: ViewingVolume, name: str, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels of a view that have a voxel on their ray."""
    mask = np.zeros(size[0] * size[1], np.uint8)
    places = volume.places[name]
    mask[places[places >= 0]] = 1
    return cv2.dilate(mask.reshape(size), _window(volume.reach_px[name])).view(bool)


def ask_other_views(volume: ViewingVolume, odds: Mapping[str, Float32[np.ndarray, "_ _"]]) -> dict[str, OtherViews]:
    """Combines, for each view, the log odds of all other views along the rays of its pixels. ``odds``: log odds of
    subject against background, by view."""
    count = len(next(iter(volume.places.values())))
    total, seen, against = np.zeros(count, np.float32), np.zeros(count, np.int32), np.zeros(count, np.int32)
    grants = min(MAX_GRANTS, GRANTS_SUM / max(1, len(odds) - 1))
    words: dict[str, Float32[np.ndarray, " n"]] = {}
    doubts: dict[str, Bool[np.ndarray, " n"]] = {}
    for name, field in odds.items():
        places = volume.places[name]
        shown = places >= 0
        at = np.where(shown, places, 0)
        words[name] = np.where(shown, np.clip(field.ravel()[at], -MAX_DENIES, grants), 0).astype(np.float32)
        width = 2 * volume.reach_px[name] + 1
        around = cv2.erode(field, np.ones((width, width), np.uint8), borderValue=2 * SOLID_ODDS)
        doubts[name] = shown & (around.ravel()[at] < SOLID_ODDS)
        total, seen, against = total + words[name], seen + shown, against + doubts[name]
    other_views = {}
    witnesses = min(MIN_WITNESSES, len(odds) - 1)  # of three cameras no voxel has three others
    for name, field in odds.items():
        places = volume.places[name]
        witnessed = (places >= 0) & (seen > witnesses)
        support = np.full(field.size, -MAX_DENIES * len(odds), np.float32)
        np.maximum.at(support, places[witnessed], (total - words[name])[witnessed])
        if witnesses < MIN_WITNESSES:  # two views from nearly one side take the same wall for the subject
            support = np.minimum(support, np.float32(0.0))
        wanted = max(MIN_WITNESSES, WITNESSES_SHARE * (len(odds) - 1))
        held = witnessed & (against == doubts[name]) & (seen - 1 >= wanted)
        solid = np.zeros(field.size, np.uint8)
        solid[places[held]] = 1
        window = _window(volume.reach_px[name])
        closed = cv2.morphologyEx(solid.reshape(field.shape), cv2.MORPH_CLOSE, window).view(bool)
        other_views[name] = OtherViews(cv2.dilate(support.reshape(field.shape), window), closed)
    return other_views


def _window(reach: int) -> np.ndarray:
    return np.ones((reach | 1, reach | 1), np.uint8)

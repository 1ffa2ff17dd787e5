"""Packs the depth maps of all views, and signed distances to the outlines, into flat arrays for compiled loops.

The subject's surface lies inside every silhouette. If depth points of two views fall outside the silhouette of a third
view, this silhouette is ignored there, so that a bad mask cuts no hole. Points close outside an outline contradict
nothing, since matching windows make thin things (frames of glasses, the edge of a collar) wider.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int16, Int64

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.vote_kernels import (
    BLOCK,
    FRAME,
    NORMAL,
    NORMAL_STEP,
    OUTLINE,
    PIXEL_STEP,
    SIGMA,
    SIGMA_STEP_MM,
    UNKNOWN,
    Pixels,
    mark_contradicted,
    write_outline,
)
from pipeline.geometry.projection import packed_lens
from pipeline.geometry.projection_kernels import LENS
from pipeline.imaging.silhouette import Silhouette
from pipeline.stereo.depth_map import DepthMap
from rig.camera import Camera
from rig.rig import Rig

MAX_STEPS = np.iinfo(np.int16).max
MIN_VIEWS = 2  # that see something solid, for an outline to be contradicted
WIDENED_PX = 10.0  # by windows: glasses and collars of good captures, 8 px beyond their outlines
SILENT_PX = -1000.0  # an outline that is so far away bounds nothing
VIEWS_SURE = 3  # a depth that only two views agree on may be a chance match ...
ALONE_FACTOR = 3.0  # ... and has its deviation multiplied: 28 % of them are 2 mm off, 4 % of those that three agree on


@dataclass(frozen=True, slots=True, eq=False)
class ViewStack:
    """Holds the pixels of all views' crops in flat arrays, one view after the other.

    ``cameras`` has a row for each view: rotation (9), translation (3), fx fy cx cy, and the centre in the world frame
    (3). ``shown`` has a row of integers for each pixel, in units that ``vote_kernels`` defines: normal (3, world frame,
    towards the camera), standard deviation of the depth, and signed distances (negative inside) to the silhouette's
    contour and to the photograph's border.
    """

    cameras: Float[np.ndarray, "k 19"]
    sizes: Int64[np.ndarray, "k 2"]  # height, width
    starts: Int64[np.ndarray, " k"]
    depth_mm: Float32[np.ndarray, " p"]  # 0 where nothing is known
    shown: Int16[np.ndarray, "p 6"]

    def packed(self) -> Pixels:
        """Returns the arrays as a named tuple, which compiled loops accept."""
        return Pixels(self.cameras, self.sizes, self.starts, self.depth_mm, self.shown)

    def outside(self, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 k n"]:
        """Returns the signed distances (mm, negative inside) of points (world frame, mm) to each photograph's border
        and to its silhouette; both are infinite behind the camera."""

        def outside_of(view: int) -> Float[np.ndarray, "2 n"]:
            camera, size = self.cameras[view], self.sizes[view][::-1]
            x, y, z = camera[:9].reshape(3, 3) @ places.T + camera[9:12, None]
            fx, fy, cx, cy = camera[LENS : LENS + 4]
            depth = np.maximum(z, 1.0)
            u, v = fx * x / depth + cx, fy * y / depth + cy
            column, row = np.clip(u, 0, size[0] - 1.0), np.clip(v, 0, size[1] - 1.0)
            pixel = self.starts[view] + np.rint(row).astype(int) * size[0] + np.rint(column).astype(int)
            edge, outline = (PIXEL_STEP * self.shown[pixel, channel] for channel in (FRAME, OUTLINE))
            beyond = edge + np.hypot(u - column, v - row)
            return np.where(z > 1.0, np.stack([beyond, outline]) * depth / fx, np.inf)

        return np.stack(map_in_threads(outside_of, len(self.cameras)), axis=1)


def stack_views(depth_maps: Sequence[DepthMap], silhouettes: Mapping[str, Silhouette], rig: Rig) -> ViewStack:
    """Packs the depth maps and silhouettes into flat arrays, one view after the other, in the order of the depth
    maps."""
    sizes = np.array([depth_map.depth_mm.shape for depth_map in depth_maps], np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))])
    depth_mm, shown = np.empty(starts[-1], np.float32), np.empty((starts[-1], 6), np.int16)

    def fill(view: int) -> None:
        depth_map = depth_maps[view]
        camera, rows = rig[depth_map.camera.name], slice(starts[view], starts[view + 1])
        depth_mm[rows] = depth_map.depth_mm.ravel()
        shown[rows, NORMAL : NORMAL + 3] = np.rint(depth_map.normal.reshape(-1, 3) * np.float32(1 / NORMAL_STEP))
        deviation = depth_map.deviation_mm.ravel() * np.where(
            depth_map.views.ravel() < VIEWS_SURE, np.float32(ALONE_FACTOR), np.float32(1)
        )
        steps = np.rint(np.minimum(deviation * np.float32(1 / SIGMA_STEP_MM), np.float32(MAX_STEPS)))
        shown[rows, SIGMA] = np.where(np.isfinite(deviation), steps, UNKNOWN)
        crop = depth_map.camera.intrinsics.values()[:4]
        write_outline(
            crop, packed_lens(camera), depth_map.depth_mm.shape[1], silhouettes[camera.name].distance, shown[rows]
        )

    map_in_threads(fill, len(depth_maps))
    cameras = np.stack([_packed(depth_map.camera) for depth_map in depth_maps])
    return ViewStack(cameras, sizes, starts[:-1], depth_mm, shown)


def _packed(camera: Camera) -> Float[np.ndarray, " 19"]:
    pose = camera.camera_from_world
    return np.concatenate(
        [pose.rotation.ravel(), pose.translation, camera.intrinsics.values()[:4], camera.centre_world]
    )


@traced
def silence_contradicted(views: ViewStack) -> tuple[ViewStack, Float[np.ndarray, " k"]]:
    """Disables outlines where other views contradict them. Returns the views with the outline distance of these pixels
    set to ``SILENT_PX``, and for each view the contradicted fraction of its crop."""

    def wrong_pixels(v: int) -> Bool[np.ndarray, "h w"] | None:
        height, width = views.sizes[v]
        blocks = np.zeros((height // BLOCK + 1, width // BLOCK + 1), np.uint64)
        mark_contradicted(v, views.packed(), blocks, width)
        solid = np.bitwise_count(blocks) >= MIN_VIEWS
        outline_px = PIXEL_STEP * views.shown[views.starts[v] : views.starts[v] + height * width, OUTLINE]
        return _beyond_windows(solid, outline_px.reshape(height, width)) if solid.any() else None

    wrong = map_in_threads(wrong_pixels, len(views.cameras))
    shares = np.array([0.0 if mask is None else mask.mean() for mask in wrong])
    if not shares.any():  # as usual: fifty megabytes need no copy
        return views, shares
    shown = views.shown.copy()
    for start, mask in zip(views.starts, wrong, strict=True):
        if mask is not None:
            shown[start : start + mask.size, OUTLINE][mask.ravel()] = SILENT_PX / PIXEL_STEP
    return replace(views, shown=shown), shares


def _beyond_windows(solid: Bool[np.ndarray, "r c"], outline_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels in and next to solid blocks. Only connected groups of blocks that extend more than
    ``WIDENED_PX`` beyond the outline are kept, since matching windows widen things by up to this distance."""
    height, width = outline_px.shape
    count, found = cv2.connectedComponents(cv2.dilate(solid.view(np.uint8), np.ones((3, 3), np.uint8)))
    labels = np.asarray(found, np.int32)
    middle = BLOCK // 2
    rows, columns = (
        np.minimum(middle + BLOCK * np.arange(n), size - 1)
        for n, size in zip(solid.shape, (height, width), strict=True)
    )
    part, farthest = np.asarray(labels, np.int32), np.zeros(count)
    np.maximum.at(farthest, part, np.where(solid, outline_px[np.ix_(rows, columns)], 0.0))
    wrong = farthest[part] > WIDENED_PX
    return np.kron(wrong, np.ones((BLOCK, BLOCK), bool))[:height, :width]

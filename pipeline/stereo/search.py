"""Finds the first depth of every pixel: depths at even steps through its range are tried, and the one is chosen that
agrees with neighbouring pixels along paths.

It is searched twice. The first time windows are slanted as the bounds of the range are. Where a photograph ends, no
silhouette bounds the hull, which then stands steeper than a shirt; windows that lie so match nothing, though the
photographs show the place well. The second time the windows of wide ranges lie as the depths found around them do.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32

from pipeline.compute.threads import map_in_threads
from pipeline.stereo.depth_map import Field
from pipeline.stereo.depth_range import REACH_MM, STEEPEST, DepthRange
from pipeline.stereo.matcher import Matching
from pipeline.stereo.sweep_kernels import aggregate
from rig.camera import Camera

LABELS = 21  # depths along a ray in each of two sweeps: 4.5 mm apart at the deepest; 41 are no better
# On the subject, of images that are searched: windows of 5 pixels then span 10 mm. At 512 x 384 a quarter of the size,
# 4.2 mm a pixel, left 21 % of the face 2 mm off, half of it leaves 14 % (an oily head, noise of 6 levels).
SEARCH_PIXEL_MM = 2.1
FIRST_LEVELS = (1, 2)  # half and quarter of the photographs' size
WIDE_MM = 60.0  # of a range: nothing but the hull bounds it. The fitted head's slopes are better than found ones
AROUND_PX = 3.0  # sigma of the window over which slopes are found: 6 mm. With 4 and 6 less of all is right
EVEN_PX2 = 0.5  # variance of places that is added: a single line of pixels has no slope across
# Costs are 1 minus a correlation. A step of one label is a slope that the room's bounds do not have; a wider step is an
# edge, which three or four pixels of clear texture pay for.
STEP_COST, EDGE_COST = np.float32(0.1), np.float32(0.8)


def find_search_level(cameras: Sequence[Camera], at_world: Float[np.ndarray, " 3"]) -> int:
    """Returns how often the crops are halved for the search, so that a pixel is about ``SEARCH_PIXEL_MM`` wide at the
    subject.

    Args:
        cameras: of the crops at full size; one at least.
        at_world: about the middle of the subject, mm.
    """
    depths = [float(camera.camera_from_world.apply(at_world)[2]) for camera in cameras]
    pixel_mm = np.median([depth / camera.intrinsics.fx for depth, camera in zip(depths, cameras, strict=True)])
    halvings = int(np.rint(np.log2(SEARCH_PIXEL_MM / max(float(pixel_mm), 1e-9))))
    return min(max(halvings, FIRST_LEVELS[0]), FIRST_LEVELS[-1])


def first_fields(matching: Matching, depth_ranges: Sequence[DepthRange]) -> list[Field]:
    """Finds a first depth in every view by trying depths at even steps through the range of each pixel, twice. The
    fields have no information yet (0)."""

    def work(view: int) -> Field:
        room, matcher = depth_ranges[view], matching.matcher(view)
        strides = label_strides(room)
        field = _cheapest(matcher.sweep(room, strides, LABELS), room, strides)
        room = slanted(room, field, float(matching.stack.lens[view, 0]))
        return _cheapest(matcher.sweep(room, strides, LABELS), room, strides)

    return map_in_threads(work, len(matching.stack))


def slanted(room: DepthRange, field: Field, lens: float) -> DepthRange:
    """Returns the range with the slopes of the field's surroundings for both bounds where it is wider than ``WIDE_MM``.
    ``lens`` is the focal length in pixels."""
    live = field.depth > 0.0
    if not live.any():
        return room
    steepest = STEEPEST * float(field.depth[live].mean()) / lens
    slopes = np.clip(slopes_around(field.depth), -steepest, steepest)
    wide = (room.far - room.near > WIDE_MM)[:, :, None]
    return DepthRange(room.near, room.far, np.where(wide, np.concatenate([slopes, slopes], axis=2), room.slopes))


def slopes_around(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 2"]:
    """Returns the slopes (mm a pixel, by x and y) of the plane that fits the depths around each pixel best. Depths of 0
    are unknown; one at least is known."""
    live = depth > 0.0
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float64)
    known, height = live.astype(np.float64), np.where(live, depth - depth[live].mean(), 0.0)
    total = np.maximum(cv2.GaussianBlur(known, (0, 0), AROUND_PX), 1e-12)

    def mean(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return cv2.GaussianBlur(known * values, (0, 0), AROUND_PX) / total

    x, y, z = mean(column), mean(row), mean(height)
    xx, yy, xy = mean(column**2) - x * x + EVEN_PX2, mean(row**2) - y * y + EVEN_PX2, mean(column * row) - x * y
    xz, yz = mean(column * height) - x * z, mean(row * height) - y * z
    slopes = np.stack([yy * xz - xy * yz, xx * yz - xy * xz], axis=2) / (xx * yy - xy * xy)[:, :, None]
    return slopes.astype(np.float32)


def label_strides(room: DepthRange) -> Int32[np.ndarray, "h w"]:
    """Returns how many depths each pixel advances from one matched depth to the next: 1, 2, 4 and so on. A narrow range
    needs fewer of them for the same spacing in mm."""
    depth = np.clip(room.far - room.near, REACH_MM / LABELS, REACH_MM)
    return (2 ** np.floor(np.log2(REACH_MM / depth))).astype(np.int32)


def _cheapest(cost: Float32[np.ndarray, "h w d"], room: DepthRange, strides: Int32[np.ndarray, "h w"]) -> Field:
    """Returns the field of the labels whose aggregated path cost is least, refined within a stride by the unaggregated
    matching costs."""
    paths = np.empty_like(cost)
    aggregate(cost, room.far > 0.0, STEP_COST, EDGE_COST, paths)
    labels = cost.shape[2]
    best = (paths.argmin(axis=2) + strides // 2) // strides * strides  # a label that was matched
    best = np.clip(best, strides, labels - 1 - strides)
    before, at, after = (
        np.take_along_axis(cost, (best + j * strides)[:, :, None], axis=2)[:, :, 0] for j in (-1, 0, 1)
    )
    within = np.clip(0.5 * (before - after) / np.maximum(before + after - 2.0 * at, 1e-6), -0.5, 0.5)
    share = (best + strides * within) / (labels - 1)
    depth = np.where(room.far > 0.0, room.near + share * (room.far - room.near), 0.0).astype(np.float32)
    slopes = room.slopes[:, :, :2] + share[:, :, None] * (room.slopes[:, :, 2:] - room.slopes[:, :, :2])
    zero = np.zeros_like(depth)
    return Field(depth, slopes.astype(np.float32), zero, zero, zero)

"""Finds the range of possible depths of the subject along each ray: from the front of the visual hull to the fitted
head or to the back of the hull.

Hair lies between skull and hull, clothes inside the hull, and skin within a few mm of the fitted head, so the range is
short. The range is computed on the smallest crops. The range's two bounds are smooth surfaces, between which the search
interpolates slopes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.compute.threads import map_in_threads
from pipeline.geometry.projection import depth_map
from pipeline.stereo.crops import MAX_UNSEEN_PX, Crop
from pipeline.stereo.depth_map_kernels import find_depth_range
from pipeline.stereo.stack import Stack
from rig.mesh import Mesh

Plane = Float32[np.ndarray, "h w"]

REACH_MM = 90.0  # behind the hull's front where the fitted head bounds nothing: hair is 60 mm thick at most
BEHIND_HEAD_MM = 6.0  # how far the surface may lie behind the fitted head: its error beside the face
BEFORE_HEAD_MM = 60.0  # depth of what stands before the fitted head: hair, a beard, a cap's brim
STEPS = 128  # along a ray through the subject
SLACK_PX = 1.0  # of the least size: a mask may be that narrow
MIN_ROOM_MM = 4.0
BOUND_BLUR_PX = 1.0  # of the least size: the hull has creases that the subject does not have
LOOSE_HULL_MM = 30.0  # of a hull's front before the fitted head: 5 to 15 for cameras around a head, 100 for three in
# front
STEEPEST = 3.0  # slope against the image plane: 72 degrees


@dataclass(frozen=True, slots=True, eq=False)
class DepthRange:
    """Holds the range of depths to search in one view. Each pixel has the smallest and the largest depth (mm), 0 for no
    search, and the slopes of these two bounds by x and y (mm per pixel)."""

    near: Plane
    far: Plane
    slopes: Float32[np.ndarray, "h w 4"]  # of near by x and y, of far by x and y


def find_depth_ranges(
    crops: Sequence[Crop],
    least: Stack,
    stack: Stack,
    head_world: Mesh | None,
    extent: tuple[Float[np.ndarray, " 3"], float],
) -> list[DepthRange]:
    """Finds the range of depths to search in every view, at the image size of ``stack``.

    Args:
        crops: of the views.
        least: the crops at their smallest size, at which the range is first computed.
        stack: the crops at the size of the search.
        head_world: the fitted head, world frame, mm; without it the range ends ``reach_mm`` behind the hull's front.
        extent: middle (world) and edge length (mm) of a cube that contains the subject.
    """

    def work(view: int) -> DepthRange:
        near, far = _bounds(crops[view], least, view, head_world, extent)
        return _enlarged(near, far, stack, view)

    return map_in_threads(work, len(crops))


def _bounds(
    crop: Crop, least: Stack, view: int, head_world: Mesh | None, extent: tuple[Float[np.ndarray, " 3"], float]
) -> tuple[Plane, Plane]:
    """Returns the nearest and farthest depth (mm) of each pixel at the smallest size; 0 where no depth is possible."""
    camera = crop.levels[-1].camera
    centre, edge = extent
    middle, half = float(camera.camera_from_world.apply(centre)[2]), 0.5 * np.sqrt(3.0) * edge
    step = 2.0 * half / STEPS
    width, height = least.size[view]
    others = np.delete(np.arange(len(least)), view)
    near, far = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    find_depth_range(
        int(least.offset[view]), least.homographies(view, others), least.distance_px, SLACK_PX, max(middle - half, 1.0),
        middle + half, step, near, far,
    )  # fmt: skip
    room = near > 0.0
    near[room] -= step
    if head_world is None:
        far[room] = np.minimum(far[room], near[room] + REACH_MM)
    else:
        head, _ = depth_map(camera, head_world.vertices, head_world.faces)
        _bound_by_head(near, far, room, head)
    far[room] = np.maximum(far[room], near[room] + MIN_ROOM_MM + step)
    return near, far


def _bound_by_head(near: Plane, far: Plane, room: Bool[np.ndarray, "h w"], head: Float[np.ndarray, "h w"]) -> None:
    """Narrows the bounds, in place, to depths near the fitted head. ``head`` is the head's depth map (mm, infinite
    beside the head).

    If all cameras stand on one side, the visual hull begins decimetres in front of the face. In this case the bounds
    follow from the head's depth at the pixel or, beside the head, from its least and greatest depth.
    """
    seen = room & np.isfinite(head)
    if not seen.any() or np.median((head - near)[seen]) < LOOSE_HULL_MM:
        far[room] = np.minimum(far[room], near[room] + REACH_MM)
    else:
        beside = room & ~seen
        near[beside] = np.maximum(near[beside], float(head[seen].min()) - BEFORE_HEAD_MM)
        far[beside] = np.minimum(far[beside], float(head[seen].max()) + BEFORE_HEAD_MM)
        near[seen] = np.maximum(near[seen], head[seen] - BEFORE_HEAD_MM)
    far[seen] = np.minimum(far[seen], head[seen] + BEHIND_HEAD_MM)


def _enlarged(near: Plane, far: Plane, stack: Stack, view: int) -> DepthRange:
    """Smooths the bounds, upsamples them to the size of ``stack``, and extends them over every pixel of the subject."""
    room = near > 0.0
    width, height = (int(side) for side in stack.size[view])
    distance = stack.image(stack.distance_px, view)
    live = (distance < 1.0) & (distance > MAX_UNSEEN_PX)
    if not room.any():
        return DepthRange(np.zeros_like(distance), np.zeros_like(distance), np.zeros((height, width, 4), np.float32))
    bounds, slopes = [], []
    for values in (near, far):
        wide = cv2.resize(_extended(values, room), (width, height), interpolation=cv2.INTER_LINEAR)
        steepest = STEEPEST * float(wide.mean() / stack.lens[view, 0])
        slopes += [np.clip(slope, -steepest, steepest) for slope in np.gradient(wide)[::-1]]
        bounds.append(np.where(live, wide, np.float32(0.0)))
    return DepthRange(bounds[0], bounds[1], np.stack(slopes, axis=2).astype(np.float32))


def _extended(values: Plane, room: Bool[np.ndarray, "h w"]) -> Plane:
    """Blurs the values at pixels with a depth range; others take the value of the nearest such pixel."""
    weight = cv2.GaussianBlur(room.astype(np.float32), (0, 0), BOUND_BLUR_PX)
    smooth = cv2.GaussianBlur(np.where(room, values, np.float32(0.0)), (0, 0), BOUND_BLUR_PX) / np.maximum(weight, 1e-3)
    _, nearest = cv2.distanceTransformWithLabels(
        (~room).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = nearest.astype(np.int64)
    values_of = np.zeros(int(nearest.max()) + 1, np.float32)
    values_of[nearest[room]] = smooth[room]
    return values_of[nearest]

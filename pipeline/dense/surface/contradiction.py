"""Outlines that the depth of other views contradicts: a mask that leaves out what two of them see solid is wrong there.

A surface lies inside every silhouette, hidden or not. Where points of two views fall outside a third one's, that one's
outline says nothing any more, so that one bad mask cuts no hole through what the others know. Near an outline it is the
depth that errs: matching windows make what is thin (frames of glasses, a collar's edge) wider by their own size, in
every view alike.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.compiled import njit
from pipeline.dense.surface.view_stack import ViewStack
from pipeline.dense.surface.vote_kernels import CENTRE, DEPTH, FRAME, OUTLINE, SIGMA, nearest_pixel, seen_at
from pipeline.imaging.projection_kernels import LENS, NEAREST_MM
from pipeline.parallel_for import map_in_threads

BLOCK = 4  # pixels along the side of what is decided at once
STRIDE = 3  # every third pixel of every third row stands for the others
CLEAR_PX = 2.5  # a point nearer to the outline is ordinary: blur, hair, calibration
SURE_MM = 1.0  # points with a larger deviation do not count
VIEWS_LEAST = 2  # that see something solid
WIDENED_PX = 10.0  # by windows: glasses and collars of good captures, 8 px beyond their outlines
SILENT_PX = -1000.0  # an outline that is so far away bounds nothing


def silence_contradicted(views: ViewStack) -> tuple[ViewStack, Float[np.ndarray, " k"]]:
    """The views without the outlines that others contradict, and by view the share of its crop that was."""

    def wrong_pixels(v: int) -> Bool[np.ndarray, "h w"] | None:
        height, width = views.sizes[v]
        blocks = np.zeros((height // BLOCK + 1, width // BLOCK + 1), np.uint64)
        _mark(v, views.cameras, views.sizes, views.starts, views.pixels, blocks, width)
        solid = np.bitwise_count(blocks) >= VIEWS_LEAST
        own = views.pixels[views.starts[v] : views.starts[v] + height * width, OUTLINE]
        return _beyond_windows(solid, own.reshape(height, width)) if solid.any() else None

    wrong = map_in_threads(wrong_pixels, len(views.cameras))
    shares = np.array([0.0 if mask is None else mask.mean() for mask in wrong])
    if not shares.any():  # as usual: a hundred megabytes need no copy
        return views, shares
    pixels = views.pixels.copy()
    for start, mask in zip(views.starts, wrong, strict=True):
        if mask is not None:
            pixels[start : start + mask.size, OUTLINE][mask.ravel()] = SILENT_PX
    return ViewStack(views.cameras, views.sizes, views.starts, pixels), shares


def _beyond_windows(solid: Bool[np.ndarray, "r c"], outline_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels in and next to solid blocks, of those connected ones that reach farther beyond the outline than windows
    make anything wider."""
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


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(
    target: int,
    cameras: np.ndarray,
    sizes: np.ndarray,
    starts: np.ndarray,
    pixels: np.ndarray,
    blocks: np.ndarray,
    width: int,
) -> None:
    """Sets the bit of each view that has a sure point in a block outside of the target's outline."""
    place = np.empty(3)
    for v in range(len(cameras)):
        if v == target:
            continue
        p, bit = cameras[v], np.uint64(1) << np.uint64(v % 64)
        for row in range(0, sizes[v, 0], STRIDE):
            for column in range(0, sizes[v, 1], STRIDE):
                at = starts[v] + row * sizes[v, 1] + column
                if not pixels[at, SIGMA] < SURE_MM:
                    continue
                depth = pixels[at, DEPTH]
                x, y = (column - p[LENS + 2]) / p[LENS] * depth, (row - p[LENS + 3]) / p[LENS + 1] * depth
                for axis in range(3):  # the rotation's inverse, from the camera's centre
                    place[axis] = p[axis] * x + p[3 + axis] * y + p[6 + axis] * depth + p[CENTRE + axis]
                ahead, at_column, at_row = seen_at(cameras[target], place)
                if ahead <= NEAREST_MM:
                    continue
                near, beyond = nearest_pixel(at_column, at_row, sizes[target])
                there = starts[target] + near
                if beyond == 0.0 and pixels[there, FRAME] < 0.0 and pixels[there, OUTLINE] > CLEAR_PX:
                    blocks[near // width // BLOCK, near % width // BLOCK] |= bit

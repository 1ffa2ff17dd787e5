"""Removes outlines that the depth of other views contradicts: a mask is wrong where it lacks what two other views
measure.

A surface lies inside every silhouette, hidden or not. Where points of two views fall outside a third one's silhouette,
that outline is ignored, so that one bad mask cuts no hole into the surface. Close to an outline it is the depth that is
wrong: matching windows make thin things (frames of glasses, the edge of a collar) wider by their own size, in every
view alike.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.view_stack import ViewStack
from pipeline.fusion.vote_kernels import BLOCK, OUTLINE, PIXEL_STEP, mark_contradicted

MIN_VIEWS = 2  # that see something solid
WIDENED_PX = 10.0  # by windows: glasses and collars of good captures, 8 px beyond their outlines
SILENT_PX = -1000.0  # an outline that is so far away bounds nothing


@traced
def silence_contradicted(views: ViewStack) -> tuple[ViewStack, Float[np.ndarray, " k"]]:
    """Removes the outlines where other views contradict them. Returns the views with those pixels' outline distance set
    to ``SILENT_PX``, and for each view the share of its crop that was contradicted."""

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
    """Returns the pixels in and next to solid blocks. Keeps only connected groups of blocks that reach farther than
    ``WIDENED_PX`` beyond the outline, since matching windows widen things by up to that."""
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

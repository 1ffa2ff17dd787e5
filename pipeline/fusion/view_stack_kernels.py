"""Compiled loops over the pixels of views: what their outlines say, and where other views contradict them."""

import numpy as np

from pipeline.fusion.vote_kernels import (
    CENTRE,
    FRAME,
    OUTLINE,
    PIXEL_STEP,
    SIGMA,
    SIGMA_STEP_MM,
    UNKNOWN,
    Pixels,
    nearest_pixel,
    seen_at,
)
from pipeline.geometry.projection_kernels import LENS, NEAREST_MM, distorted
from pipeline.imaging.sampling_kernels import held, sample
from rig.jit import njit

BLOCK = 4  # pixels along the side of what is decided at once
STRIDE = 3  # every third pixel of every third row stands for the others
CLEAR_PX = 2.5  # a point nearer to the outline is ordinary: blur, hair, calibration
SURE_MM = 1.0  # points with a larger deviation do not count


@njit(cache=True, nogil=True, error_model="numpy")
def mark_contradicted(target: int, views: Pixels, blocks: np.ndarray, width: int) -> None:
    """Marks blocks of the view ``target`` in which other views have a precise surface point outside of its outline:
    sets bit v % 64 of ``blocks`` (rows, columns; words of 64 bits, changed in place) for each such view v.

    ``width`` is the target's width in pixels. A block is ``BLOCK`` pixels wide.
    """
    cameras, sizes, starts, depths, shown = views
    place = np.empty(3)
    for v in range(len(cameras)):
        if v == target:
            continue
        p, bit = cameras[v], np.uint64(1) << np.uint64(v % 64)
        for row in range(0, sizes[v, 0], STRIDE):
            for column in range(0, sizes[v, 1], STRIDE):
                at = starts[v] + row * sizes[v, 1] + column
                if shown[at, SIGMA] == UNKNOWN or shown[at, SIGMA] * SIGMA_STEP_MM >= SURE_MM:
                    continue
                depth = depths[at]
                x, y = (column - p[LENS + 2]) / p[LENS] * depth, (row - p[LENS + 3]) / p[LENS + 1] * depth
                for axis in range(3):  # the rotation's inverse, from the camera's centre
                    place[axis] = p[axis] * x + p[3 + axis] * y + p[6 + axis] * depth + p[CENTRE + axis]
                ahead, at_column, at_row = seen_at(cameras[target], place)
                if ahead <= NEAREST_MM:
                    continue
                near, beyond = nearest_pixel(at_column, at_row, sizes[target])
                there = starts[target] + near
                if beyond == 0.0 and shown[there, FRAME] < 0 and shown[there, OUTLINE] * PIXEL_STEP > CLEAR_PX:
                    blocks[near // width // BLOCK, near % width // BLOCK] |= bit


@njit(cache=True, nogil=True)
def write_outline(crop: np.ndarray, lens: np.ndarray, width: int, distance: np.ndarray, shown: np.ndarray) -> None:
    """Fills two columns of ``shown`` in steps of ``PIXEL_STEP``: the signed distances (px of the crop) to the
    silhouette's contour and to the photograph's border, both negative inside, at the pixels of an undistorted crop.

    Outside the photograph the distance to the contour is that of the nearest pixel on its border, so that a shoulder
    which the border cuts goes on. ``crop`` is fx, fy, cx, cy of the crop; ``lens`` that of the photograph
    (``packed_lens``); ``width`` the crop's; ``distance`` (rows, columns) the silhouette's signed distance.
    """
    rows, columns = distance.shape
    steps = crop[0] / lens[0] / PIXEL_STEP  # a crop of fewer pixels has shorter distances
    for at in range(len(shown)):
        u, v = distorted((at % width - crop[2]) / crop[0], (at // width - crop[3]) / crop[1], lens)
        shown[at, FRAME] = _stepped(steps * max(max(-u, u - (columns - 1)), max(-v, v - (rows - 1))))
        shown[at, OUTLINE] = _stepped(steps * sample(distance, held(u, columns), held(v, rows)))


@njit(cache=True, nogil=True, inline="always")
def _stepped(value: float) -> int:
    return round(min(max(value, -32767.0), 32767.0))

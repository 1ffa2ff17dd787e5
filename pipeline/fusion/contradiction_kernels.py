"""Compiled loop that finds where other views see the subject outside of a view's outline."""

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
from pipeline.geometry.projection_kernels import LENS, NEAREST_MM
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

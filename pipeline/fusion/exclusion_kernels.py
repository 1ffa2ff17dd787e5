"""Compiled loop that tells, a block of grid nodes at once, where two silhouettes say that nobody is."""

import numpy as np

from pipeline.fusion.vote_kernels import FRAME, OUTLINE, PIXEL_STEP, Pixels, nearest_pixel, seen_at
from pipeline.geometry.projection_kernels import LENS, NEAREST_MM
from rig.jit import njit

BLOCK = 3  # nodes along the side of a block
STRETCH = 1.5  # most by which a lens lengthens a way on the photograph, that to the corner of a pixel included
PIXEL_PX = 1.5  # from a place to the middle of its pixel, and its distance's rounding: before the stretch


@njit(cache=True, nogil=True, error_model="numpy")
def mark_excluded(
    shape: tuple[int, int, int],
    corner: np.ndarray,
    step_mm: float,
    views: Pixels,
    steady: np.ndarray,
    reach_mm: float,
    excluded: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Sets ``excluded`` (nodes of a whole box of ``shape``, in the order of their keys) at the nodes of those blocks
    that lie more than ``reach_mm`` outside two silhouettes with all their nodes; ``vote`` gives such nodes no weight,
    and ``reach_mm`` as their bound. Works on the layers ``first`` to ``last`` of blocks along the first axis.

    Distances to an outline change by no more than the way from pixel to pixel, so that the pixel at the middle of a
    block bounds them at all of its nodes. Only ``steady`` views count, of whose outline nothing was silenced.
    """
    nx, ny, nz = shape
    cameras, sizes, starts, _, shown = views
    place, half = np.empty(3), 0.5 * (BLOCK - 1)
    radius = np.sqrt(3.0) * half * step_mm
    for i in range(first * BLOCK, min(last * BLOCK, nx), BLOCK):
        for j in range(0, ny, BLOCK):
            for k in range(0, nz, BLOCK):
                place[0] = corner[0] + step_mm * (i + half)
                place[1] = corner[1] + step_mm * (j + half)
                place[2] = corner[2] + step_mm * (k + half)
                outside = 0
                for v in range(len(cameras)):
                    depth, column, row = seen_at(cameras[v], place)
                    if not steady[v] or depth - radius <= NEAREST_MM:
                        continue
                    near, beyond = nearest_pixel(column, row, sizes[v])
                    near += starts[v]
                    # A node at the edge of the block is nearer to the camera, and lies across its line of sight.
                    tilt = np.hypot(column - cameras[v, LENS + 2], row - cameras[v, LENS + 3]) / cameras[v, LENS]
                    way = STRETCH * (PIXEL_PX + radius * (1.0 + tilt) * cameras[v, LENS] / (depth - radius))
                    if PIXEL_STEP * shown[near, FRAME] + beyond + way > 0.0:
                        continue
                    outside += (PIXEL_STEP * shown[near, OUTLINE] - way) * (depth - radius) > reach_mm * cameras[
                        v, LENS
                    ]
                    if outside == 2:
                        break
                if outside == 2:
                    for a in range(i, min(i + BLOCK, nx)):
                        for b in range(j, min(j + BLOCK, ny)):
                            row_start = (a * ny + b) * nz
                            excluded[row_start + k : row_start + min(k + BLOCK, nz)] = True

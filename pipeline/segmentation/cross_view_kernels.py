"""Compiled loops of ``pipeline.segmentation.segment``."""

import numpy as np

from pipeline.geometry.projection_kernels import LENS, NEAREST_MM, distorted, placed
from rig.jit import njit

MAX_DISSENT = 3  # more dissent than this is not counted
MIN_WITNESSES = 4  # cameras that must see a point before it can be allowed
STEPS = 96  # points on a ray: 4 mm on a subject of 400 mm
SLACK = 1.0  # mask pixels by which a point may miss a mask


@njit(cache=True, nogil=True)
def least_dissent(
    origin: np.ndarray,
    rays: np.ndarray,
    span: tuple[float, float],
    cameras: np.ndarray,
    distances: np.ndarray,
    scales: np.ndarray,
) -> np.ndarray:
    """Returns, for each ray (n), the smallest number of cameras that see background at any one of its points, int8; -1
    if no point is seen by ``MIN_WITNESSES`` cameras. Numbers above ``MAX_DISSENT`` are not counted further.

    ``origin`` (3) and ``rays`` (n, 3) are in the world frame; points lie at distances in ``span`` (mm) along them.
    ``cameras`` are rows of ``packed_camera``; ``distances`` (k, h, w) the distances (px) to each camera's mask,
    negative where unknown, in images reduced by ``scales`` (k).
    """
    out = np.full(len(rays), -1, np.int8)
    step = (span[1] - span[0]) / STEPS
    for n in range(len(rays)):
        best = MAX_DISSENT + 1
        for s in range(STEPS):
            reach = span[0] + (s + 0.5) * step
            x, y, z = (origin[0] + reach * rays[n, 0], origin[1] + reach * rays[n, 1], origin[2] + reach * rays[n, 2])
            seen, against = 0, 0
            for k in range(len(cameras)):
                p = cameras[k]
                cx, cy, cz = placed(p, x, y, z)
                if cz <= NEAREST_MM:
                    continue
                column, row = distorted(cx / cz, cy / cz, p[LENS:])
                i, j = int((row + 0.5) / scales[k]), int((column + 0.5) / scales[k])
                if row < 0 or column < 0 or i >= distances.shape[1] or j >= distances.shape[2]:
                    continue
                away = distances[k, i, j]
                if away < 0:
                    continue
                seen += 1
                against += away > SLACK + 0.5 * step * p[LENS] / (cz * scales[k])
                if against >= best:
                    break
            if seen >= MIN_WITNESSES and against < best:
                best = against
                if best == 0:
                    break
        if best <= MAX_DISSENT:
            out[n] = best
        elif best == MAX_DISSENT + 1:
            out[n] = MAX_DISSENT
    return out

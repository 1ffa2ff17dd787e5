"""Compiled loop that reads a silhouette's signed distance at the pixels of a view's crop."""

import numpy as np

from pipeline.compute.jit import njit
from pipeline.fusion.vote_kernels import FRAME, OUTLINE
from pipeline.geometry.projection_kernels import distorted
from pipeline.imaging.sampling_kernels import held, sample


@njit(cache=True, nogil=True)
def write_outline(crop: np.ndarray, lens: np.ndarray, width: int, distance: np.ndarray, pixels: np.ndarray) -> None:
    """Fills two columns of ``pixels``: the signed distances (px) to the silhouette's contour and to the photograph's
    border, both negative inside, at the pixels of an undistorted crop.

    Outside the photograph the distance to the contour is that of the nearest pixel on its border, so that a shoulder
    which the border cuts goes on. ``crop`` is fx, fy, cx, cy of the crop; ``lens`` that of the photograph
    (``packed_lens``); ``width`` the crop's; ``distance`` (rows, columns) the silhouette's signed distance.
    """
    rows, columns = distance.shape
    for at in range(len(pixels)):
        u, v = distorted((at % width - crop[2]) / crop[0], (at // width - crop[3]) / crop[1], lens)
        pixels[at, FRAME] = max(max(-u, u - (columns - 1)), max(-v, v - (rows - 1)))
        pixels[at, OUTLINE] = sample(distance, held(u, columns), held(v, rows))

"""Compiled loop that reads a silhouette's signed distance at the pixels of a view's crop."""

import numpy as np

from pipeline.fusion.vote_kernels import FRAME, OUTLINE, PIXEL_STEP
from pipeline.geometry.projection_kernels import distorted
from pipeline.imaging.sampling_kernels import held, sample
from rig.jit import njit


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

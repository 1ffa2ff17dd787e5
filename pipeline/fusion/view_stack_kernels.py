"""The compiled loop that reads a silhouette's signed distance at the pixels of a view's crop."""

import numpy as np

from pipeline.compute.jit import njit
from pipeline.fusion.vote_kernels import FRAME, OUTLINE
from pipeline.geometry.projection_kernels import distorted
from pipeline.imaging.sampling_kernels import held, sample


@njit(cache=True, nogil=True)
def write_outline(crop: np.ndarray, lens: np.ndarray, width: int, distance: np.ndarray, pixels: np.ndarray) -> None:
    """Signed distances (px) to the contour and to the frame, at the pixels of an undistorted crop.

    Beyond the frame the contour's is the nearest pixel's of the frame: a shoulder that the edge cuts goes on there.
    """
    rows, columns = distance.shape
    for at in range(len(pixels)):
        u, v = distorted((at % width - crop[2]) / crop[0], (at // width - crop[3]) / crop[1], lens)
        pixels[at, FRAME] = max(max(-u, u - (columns - 1)), max(-v, v - (rows - 1)))
        pixels[at, OUTLINE] = sample(distance, held(u, columns), held(v, rows))

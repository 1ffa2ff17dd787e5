"""Mean-field smoothing of log odds on the coarse grid."""

import numpy as np
from jaxtyping import Float, Float32

from pipeline.segmentation.background import Background
from pipeline.segmentation.mean_field_kernels import mean_field_sweeps

SMOOTHNESS = 1.0  # log odds that a neighbour of the same kind is worth
SWEEPS = 12  # of the mean field; the masks of the tests do not change after the eighth


def smooth_odds(
    odds: Float32[np.ndarray, "h w"],
    image: Float32[np.ndarray, "h w 3"],
    background: Background,
) -> Float[np.ndarray, "h w"]:
    """Returns the probability of the subject at each pixel after mean-field smoothing, in which neighbours with similar
    residuals influence each other."""
    residual = ((image - background.coarse) / np.maximum(background.noise, 1.0)).astype(np.float32)
    field = mean_field_sweeps(np.asarray(odds, np.float32), residual, SMOOTHNESS, SWEEPS)
    return 1 / (1 + np.exp(-2 * field))

"""Compiled loops of ``pipeline.results.overlays``."""

import numpy as np

from pipeline.compute.jit import njit


@njit(cache=True, nogil=True)
def tint(image, parts, colours, most, out):
    """``out``: each pixel of ``image`` moved towards the ``colours`` of its ``parts``, by at most ``most``."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            a, b, c = most * parts[y, x, 0], most * parts[y, x, 1], most * parts[y, x, 2]
            left = np.float32(1.0) - (a + b + c)
            for k in range(3):
                mixed = image[y, x, k] * left + a * colours[0, k] + b * colours[1, k] + c * colours[2, k]
                out[y, x, k] = np.uint8(mixed + np.float32(0.5))

"""Compiled loops of ``pipeline.results.overlays``."""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True)
def tint(image, parts, colours, most, out):
    """Fills ``out`` (h, w, 3; uint8) with the image, each pixel moved towards the ``colours`` (3, 3) of three parts in
    proportion to the probabilities ``parts`` (h, w, 3), by the share ``most`` where a probability is 1."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            a, b, c = most * parts[y, x, 0], most * parts[y, x, 1], most * parts[y, x, 2]
            left = np.float32(1.0) - (a + b + c)
            for k in range(3):
                mixed = image[y, x, k] * left + a * colours[0, k] + b * colours[1, k] + c * colours[2, k]
                out[y, x, k] = np.uint8(mixed + np.float32(0.5))

"""Adds to a texture what the full-size pictures show and the pictures of work size do not: finer detail. Colours over
several pixels of work size are as they were, seams and highlights included."""

import numpy as np
from jaxtyping import Float16, UInt8

from pipeline.compute.threads import in_threads
from pipeline.texturing.chart_colours import CODES, ENCODED, LINEAR
from pipeline.texturing.layout.uv_unwrap import Atlas

STRIP_ROWS = 128


def sharpened_atlas(atlas: Atlas, brightness: Float16[np.ndarray, "s s"]) -> Atlas:
    """Returns a texture with its light multiplied by the exponential of ``brightness``."""
    size = len(atlas.image)
    stored: UInt8[np.ndarray, "s s 3"] = np.empty((size, size, 3), np.uint8)  # blue first, as the painter's

    def work(first: int, last: int) -> None:
        for strip in range(first, last):
            rows = slice(strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, size))
            light = LINEAR[atlas.image[rows, :, ::-1]] * np.exp(brightness[rows].astype(np.float32))[:, :, None]
            stored[rows] = ENCODED[(CODES * np.minimum(light, 1.0) + 0.5).astype(np.int32)]

    in_threads(-(-size // STRIP_ROWS), work)
    return Atlas(atlas.layout, stored[:, :, ::-1])

"""Takes the texels of a face from textures, at one size."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from pipeline.geometry.projection_kernels import rasterise
from pipeline.texturing.layout.uv_unwrap import Layout

GRID = 512  # texels that are compared: 0.7 mm a texel, beyond what two fits differ by


def face_texels(layout: Layout, seen: Bool[np.ndarray, " v"]) -> Bool[np.ndarray, "s s"]:
    """Tells which texels of the compared size belong to the face: all corners of the texel's triangle are ``seen``, and
    so around it."""
    texels, ones = GRID * layout.uv - 0.5, np.ones(len(layout.uv))
    _, shown = rasterise(texels, ones, layout.faces, GRID, GRID)
    whole = np.asarray(seen[layout.source[layout.faces]].all(axis=1))
    inside = ((shown >= 0) & whole[shown]).astype(np.uint8)
    return cv2.erode(inside, np.ones((3, 3), np.uint8)) > 0


def texels(image: UInt8[np.ndarray, "s s 3"], where: Bool[np.ndarray, "g g"]) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of an image at the texels ``where``, after it is resized to the compared size."""
    small = cv2.resize(np.ascontiguousarray(image), (GRID, GRID), interpolation=cv2.INTER_AREA)
    return np.asarray(small)[where]

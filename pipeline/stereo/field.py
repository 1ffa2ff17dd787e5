"""Holds a view's current estimate of the surface: a plane at each pixel, and how much is known of its depth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Holds one view's current estimate of the surface: at each pixel the depth (mm along the camera's z axis, 0 where
    there is no surface) and its slopes (mm per pixel, by x and y)."""

    depth: Float32[np.ndarray, "h w"]
    slopes: Float32[np.ndarray, "h w 2"]
    information: Float32[np.ndarray, "h w"]  # 1 / mm^2 of the depth
    relief_mm: Float32[np.ndarray, "h w"]  # RMS of the depths about a pixel from the plane through them
    likeness: Float32[np.ndarray, "h w"]  # mean correlation of the views that show the place alike; 0: none

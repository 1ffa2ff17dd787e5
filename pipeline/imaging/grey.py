"""Converts photographs to grey, and estimates their noise."""

import math

import cv2
import numpy as np
from jaxtyping import Float32

LUMINANCE = np.array([0.35, 0.45, 0.2], np.float32)  # least noise for skin: its texture is in green and red alike
QUIET_LEVELS = 1.2  # noise below which matching needs no more blur


def estimate_noise(grey: Float32[np.ndarray, "h w"]) -> float:
    """Estimates the standard deviation of an image's white noise (Immerkaer 1996,
    https://doi.org/10.1006/cviu.1996.0060), with a median because edges hardly affect it. The returned noise is at
    least 0.3 grey levels, the error of rounding to 8 bits."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = cv2.filter2D(grey[::2], -1, kernel)[2:-2, 2:-2]
    return max(float(np.median(np.abs(response))) * 1.4826 / 6.0, 0.3)


def blur_growth(noise: float) -> float:
    """Returns the factor by which a photograph with this noise needs more blur before matching; 1 up to
    ``QUIET_LEVELS``. Noise hides the finest relief of smooth skin first. (Measured by ``python -m tests.laboratory
    captures --noise 6``.)"""
    return max(noise / QUIET_LEVELS, 1.0) ** 0.4


def noise_left(noise: float, sigma_px: float) -> float:
    """Returns the standard deviation that white noise has after a Gaussian blur of ``sigma_px``."""
    return noise * float(np.square(cv2.getGaussianKernel(2 * math.ceil(3.0 * sigma_px) + 1, sigma_px)).sum())

"""Computes the signed distance to a sub-pixel contour: a level of a smooth field on the pixel grid.

The contour is what marching squares draws between pixel centres. Up to ``BAND_PX`` from it, every pixel gets the exact
distance to the nearest piece of the contour. Farther away, hundredths of a pixel do not matter: the distance there is a
5 x 5 chamfer transform of the mask, exact to half a pixel and 2 %, blended in over the outer third of the band.
"""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from pipeline.imaging.contour_distance_kernels import refine_distance, segments_of_level
from pipeline.imaging.masks import box_around

BAND_PX = 12


def distance_to_level(field: Float32[np.ndarray, "h w"], level: float = 0.5) -> Float32[np.ndarray, "h w"]:
    """Computes the signed distance (px) to the contour ``field == level``, negative where the field is above it.
    Without a contour every distance is +-(h + w), a finite value so that slopes can be computed."""
    above = field > level
    near = box_around(above, BAND_PX + 1)
    segments = segments_of_level(field[near], level)
    if not len(segments):
        far = np.float32(sum(field.shape))
        return np.where(above, -far, far)
    whole = chamfer(above.view(np.uint8))
    refine_distance(whole[near], field[near], level, segments, BAND_PX)
    return whole


def chamfer(above: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Computes the signed distance (px) to a mask's edge, negative inside; half a pixel is subtracted because the
    distance transform ends at pixel centres."""
    distance = cv2.distanceTransform(1 - above, cv2.DIST_L2, cv2.DIST_MASK_5)
    distance -= np.float32(0.5)
    box = box_around(above.view(bool), 1)
    inside = cv2.distanceTransform(above[box], cv2.DIST_L2, cv2.DIST_MASK_5)
    distance[box] += above[box] - inside
    return distance

"""Operates on masks: bounding boxes, growing and shrinking, filling holes, spreading values, and the distance to a
sub-pixel contour."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.imaging.sampling_kernels import refine_distance, segments_of_level

BAND_PX = 12
FAR = 0.01  # weight of a window four times as wide, which counts where the near window is empty


def box_around(mask: Bool[np.ndarray, "h w"], margin: int) -> tuple[slice, slice]:
    """Returns the rows and columns of a mask's bounding box with a margin; empty slices if the mask is empty."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    if not width:
        return slice(0, 0), slice(0, 0)
    bottom, right = min(top + height + margin, mask.shape[0]), min(left + width + margin, mask.shape[1])
    return slice(max(top - margin, 0), bottom), slice(max(left - margin, 0), right)


def erode(mask: Bool[np.ndarray, "h w"], steps: int) -> Bool[np.ndarray, "h w"]:
    """Returns the mask shrunk by a disc of ``steps`` pixels, except at the image's border."""
    return cv2.erode(mask.view(np.uint8), _disc(steps), borderValue=1).view(bool)


def dilate(mask: Bool[np.ndarray, "h w"], steps: int) -> Bool[np.ndarray, "h w"]:
    """Returns the mask grown by a disc of ``steps`` pixels."""
    return cv2.dilate(mask.view(np.uint8), _disc(steps)).view(bool)


def fill_holes(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Returns the mask with its holes filled; a hole is background that is not connected to the image's border."""
    _, labels = cv2.connectedComponents((~mask).view(np.uint8), connectivity=4)
    reaching = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return mask | ~np.isin(labels, reaching)


def spread(
    values: Float32[np.ndarray, "h w c"], weight: Float32[np.ndarray, "h w"], sigma: float
) -> Float32[np.ndarray, "h w c"]:
    """Spreads values from pixels with a weight to all pixels: the weighted mean in a Gaussian window or, if no such
    pixel is near, in a wider window. ``sigma`` is in pixels."""
    whole = _carried(weight, sigma)
    return cv2.merge([_carried(plane * weight, sigma) / whole for plane in cv2.split(values)])


def _carried(plane: Float32[np.ndarray, "h w"], sigma: float) -> Float32[np.ndarray, "h w"]:
    near = cv2.GaussianBlur(plane, (0, 0), sigma)
    small = (max(4, plane.shape[1] // 4), max(4, plane.shape[0] // 4))
    far = cv2.GaussianBlur(cv2.resize(plane, small, interpolation=cv2.INTER_AREA), (0, 0), max(sigma, 1.0) * 2)
    near += FAR * cv2.resize(far, (plane.shape[1], plane.shape[0]), interpolation=cv2.INTER_LINEAR)
    near += 1e-6 * plane.mean() + 1e-9
    return near


def _disc(steps: int) -> UInt8[np.ndarray, "k k"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * steps + 1, 2 * steps + 1))


def distance_to_level(field: Float32[np.ndarray, "h w"], level: float = 0.5) -> Float32[np.ndarray, "h w"]:
    """Computes the signed distance (px) to the contour ``field == level``, negative where the field exceeds the level.
    Without a contour every distance is +-(h + w), a finite value with which derivatives can be computed.

    The contour is computed by marching squares between pixel centres. Within ``BAND_PX`` of the contour, every pixel
    gets the exact distance to the nearest contour segment. Farther away, the distance is a 5 x 5 chamfer transform of
    the mask, exact to half a pixel and 2 %; the two distances are blended over the outer third of the band."""
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
    """Computes the signed distance (px) to a mask's edge, negative inside, from distances between pixel centres minus
    half a pixel."""
    distance = cv2.distanceTransform(1 - above, cv2.DIST_L2, cv2.DIST_MASK_5)
    distance -= np.float32(0.5)
    box = box_around(above.view(bool), 1)
    inside = cv2.distanceTransform(above[box], cv2.DIST_L2, cv2.DIST_MASK_5)
    distance[box] += above[box] - inside
    return distance

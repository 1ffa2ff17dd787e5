"""Finds soft shadows on the backdrop at the coarse level, and light that the subject reflects onto it. Neither belongs
to the subject."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from pipeline.imaging.masks import dilated
from pipeline.segmentation.background import ANY_COLOUR_ODDS, CHANNEL_SUM

DARKEST_SHADOW = 0.55  # share of the sRGB code that a soft shadow leaves (a quarter of the light)
SHADOW_CHROMA = 0.05  # how far a shadow's colour may be from the plate's, by the light it takes


SHADOW_CHI2 = 11.3  # three channels, 99 %: what still counts as a darker piece of the plate
STEEP = 0.03  # change of a shadow's depth a coarse pixel; blurred by 7 of them, as in the tests, a shadow has 0.016
BRIGHTEST = 0.12  # share of the sRGB code that reflected light adds; 0.09 on the wall above an oily bald head
REFLECTED_CHROMA = 0.3  # how far its colour may be from the plate's: it is the subject's
SOFT_ONSET = 0.15  # depth of a shadow 2 coarse pixels before it is noticed by that 2 behind; at a sharp edge 0 to 0.06


def find_shadows(
    image: Float32[np.ndarray, "h w 3"],
    plate: Float32[np.ndarray, "h w 3"],
    chi2: Float32[np.ndarray, "h w"],
    variance: Float32[np.ndarray, "h w 3"],
    odds: Float32[np.ndarray, "h w"],
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Returns the chi-squared of each pixel against the plate in its best shade, and which pixels are soft shadows or
    reflected light: they differ from the plate, a darker or brighter shade explains them, and they begin gradually."""
    ratio = ((image * plate / variance) @ CHANNEL_SUM) / np.maximum((plate**2 / variance) @ CHANNEL_SUM, 1e-6)
    strength = np.sqrt(chi2 / (2 * ANY_COLOUR_ODDS))
    best, soft = chi2, np.zeros(odds.shape, bool)
    for sign, most, chroma in (
        (-1.0, 1 - DARKEST_SHADOW, SHADOW_CHROMA),
        (1.0, BRIGHTEST, REFLECTED_CHROMA),
    ):
        depth = np.clip(sign * (ratio - 1), 0.0, most).astype(np.float32)
        slack = variance + (chroma * depth[:, :, None] * plate) ** 2
        left = (((image - (1 + sign * depth)[:, :, None] * plate) ** 2 / slack) @ CHANNEL_SUM).astype(np.float32)
        found = _soft_shadows((left < SHADOW_CHI2) & (depth > 0) & (odds > 0), depth, strength)
        best, soft = np.where(found, left, best), soft | found
    return best, soft


def _soft_shadows(
    candidate: Bool[np.ndarray, "h w"], depth: Float32[np.ndarray, "h w"], strength: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Returns the candidates that begin softly, with plain background beside them that is already darker. A coat begins
    abruptly, also within a shadow, and is not included.

    ``strength`` is the difference to the plate, 1 where it is first noticed.
    """
    across, down = (cv2.Sobel(depth, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    candidate = candidate & (across**2 + down**2 < STEEP**2)
    noticed = (strength > 1).view(np.uint8)
    inward = cv2.distanceTransform(noticed, cv2.DIST_L2, cv2.DIST_MASK_5)
    outward = cv2.distanceTransform(1 - noticed, cv2.DIST_L2, cv2.DIST_MASK_5)
    block = np.ones((3, 3), np.uint8)  # what hangs together by less is not one shadow
    count, cores = cv2.connectedComponents(cv2.erode(candidate.view(np.uint8), block), connectivity=4)
    cores = cores.astype(np.uint16)
    labels = np.where(candidate, cv2.dilate(cores, block), 0).astype(np.int32)
    beside = cv2.dilate(cores, np.ones((9, 9), np.uint8)).astype(np.int32)
    # The first ring on either side holds the pixels that a sharp edge divides.
    within, many = _means(depth, (inward > 1.2) & (inward < 2.6) & candidate, labels, count)
    before, few = _means(depth, (outward > 1.2) & (outward < 2.6), beside, count)
    soft = (many >= 4) & (few >= 4) & (before > SOFT_ONSET * within)
    soft[0] = False
    found = soft[labels]
    fringe = candidate & (labels == 0)  # too thin for a core of its own
    return found | (fringe & dilated(found, 3))


def _means(
    values: Float32[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"], labels: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean value of each component, over the pixels ``where``, and how many pixels that is."""
    sizes = np.bincount(labels[where], minlength=count)
    return np.bincount(labels[where], values[where], count) / np.maximum(sizes, 1), sizes

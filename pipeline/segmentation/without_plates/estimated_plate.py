"""Estimates what the matting needs: the background behind the subject's border, guessed from beside it.

The plate is the photograph itself outside the mask and a margin, and inside the mean of what lies nearby. Its noise is
measured where the truth is known, by the same guess on the other side of the border. A backdrop with texture is guessed
badly; the matting then trusts the coarse mask more, and its contrast shows that.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.imaging.masks import dilated, eroded, spread, without_holes
from pipeline.segmentation.background import Background, plate_tolerance
from pipeline.segmentation.foreground import CONCLUSIVE, Decision, colours_apart, find_mixtures, whole_subject
from pipeline.segmentation.without_plates.mask_search import CoarseMask

MARGIN = 2  # coarse pixels beyond the mask in which the subject may still be
NEARBY_PX = 2.5  # coarse pixels: sigma of the window that the plate is taken from
NOISE_WINDOW_PX = 6.0  # of the window in which the guess is judged
SOLID_ODDS = np.float32(4.0)  # of what a head encloses
MIN_NOISE = 0.7  # levels: what a sensor and 8 bits leave


def decision_without_plate(
    image: UInt8[np.ndarray, "_ _ 3"], coarse: Float32[np.ndarray, "h w 3"], found: CoarseMask, *, solid: bool = False
) -> Decision:
    """Returns a decision for the matting, with a background estimated from the pixels around the mask. If ``solid``,
    the subject is a head, and holes in the mask are filled as skin or hair of the wall's colour."""
    mask, others = whole_subject(found.mask, found.odds < -1)
    odds = found.odds
    if solid:
        holes = without_holes(mask) & ~mask
        mask, odds = mask | holes, np.where(holes, np.maximum(odds, SOLID_ODDS), odds)
    outside = ~dilated(mask, MARGIN)
    background = estimated_background(image, coarse, outside)
    tolerance = plate_tolerance(background.coarse)
    variance = (background.noise**2 / 4 + tolerance**2).astype(np.float32)
    away, mixture = find_mixtures(image, coarse, background)
    paint = spread(coarse, eroded(mask, 1) * away / (1 + mixture**2), 2.0)
    clear = colours_apart(paint, background.coarse, variance) > CONCLUSIVE
    mixed = (mixture > 1) & (away > (2 * background.noise.mean(axis=2)) ** 2)
    probability = 1 / (1 + np.exp(-odds.astype(np.float64)))
    plain = outside & False
    return Decision(coarse, background, odds, probability, mask, others, paint, odds, clear, plain, mixed)


def estimated_background(
    image: UInt8[np.ndarray, "_ _ 3"], coarse: Float32[np.ndarray, "h w 3"], outside: Bool[np.ndarray, "h w"]
) -> Background:
    """Estimates the background behind the subject from the pixels ``outside`` it; the noise includes the error of that
    guess."""
    guess = spread(coarse, outside.astype(np.float32), NEARBY_PX)
    size = (image.shape[1], image.shape[0])
    share = cv2.resize(cv2.GaussianBlur(outside.astype(np.float32), (0, 0), 1.0), size, interpolation=cv2.INTER_LINEAR)
    behind = cv2.resize(guess, size, interpolation=cv2.INTER_LINEAR)
    seen = np.clip(2 * share[:, :, None] - 1, 0, 1)
    plate = np.rint(np.clip(seen * image + (1 - seen) * behind, 0, 255)).astype(np.uint8)
    far = outside & ~dilated(~outside, 2)
    test = spread(coarse, far.astype(np.float32), NEARBY_PX)
    ring = (outside & ~far).astype(np.float32)
    error = np.sqrt(spread((coarse - test) ** 2, ring, NOISE_WINDOW_PX))
    pixel = _pixel_noise(image)
    noise = np.sqrt(error**2 + np.maximum(pixel, MIN_NOISE) ** 2).astype(np.float32)
    small = cv2.resize(plate, (coarse.shape[1], coarse.shape[0]), interpolation=cv2.INTER_AREA).astype(np.float32)
    return Background(plate[None], np.ones_like(coarse), small, noise, outside, np.ones(3, np.float32))


def _pixel_noise(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, " 3"]:
    """Returns the noise of one pixel (levels) in each channel, from differences of neighbours, most of which lie on no
    edge."""
    steps = image[::4, 1:].astype(np.float32) - image[::4, :-1]
    return (1.4826 * np.median(np.abs(steps), axis=(0, 1)) / np.sqrt(2)).astype(np.float32)


def plate_noise(decision: Decision) -> float:
    """Returns the median noise (levels) of the estimated background along the subject's border; 0 without a border."""
    rim = dilated(decision.mask, MARGIN) & ~eroded(decision.mask, MARGIN)
    return float(np.median(decision.background.noise[rim])) if rim.any() else 0.0

"""Estimates the background behind the subject from the clean plate, a picture of the empty studio.

Between plate and shot the lamps drift, and a camera may change its exposure. Therefore the plate is multiplied by a
smooth gain field for each channel, estimated from the pixels that still show the background. The estimate starts at the
mode of the log ratio of image to plate. The background determines the mode, even for a large subject, because the
subject's ratios have no common value. The noise is estimated from the residuals as a function of brightness. The noise
is larger at pixels where several plates differ more.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

CoarsePicture = Float32[np.ndarray, "hc wc 3"]
Picture = Float32[np.ndarray, "h w 3"]

COARSE_COLUMNS = 256  # columns of the coarse level: 16 pixels a decision quarter the noise, and edges stay sharp
FIELD_SHARE = 0.12  # sigma of the gain field by the image's width: the drift of lamps is smoother than that
TOLERANCE_LEVELS = 0.8  # error of a plate where nothing happened: 8-bit rounding, reflected light ...
TOLERANCE_SHARE = 0.006  # ... and its part that grows with the level
ANY_COLOUR_ODDS = 9.0  # log of the plate's density, (2 pi)^-1.5 / 1.2^3 levels^-3, by that of any colour, 64^-3
CHANNEL_SUM = np.ones(3, np.float32)  # a product with it sums the channels ten times faster than .sum(axis=2)
LEVEL_BINS = 8  # bins of brightness in the noise curve
TUKEY = 4.685  # residuals (in standard deviations) beyond which a pixel says nothing of the background
BLACK = 4.0  # levels, root mean square: a backdrop below it is noise, which tells no gain
UNKNOWN = 1e6  # levels squared: draws a black channel's gain to 1
STEPS = 4  # of reweighting; the field moves by less than 0.1 grey level after the third


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Holds the clean plates and their fit to the image: a gain field, the noise, and a mask of pixels that show the
    background."""

    plates: UInt8[np.ndarray, "p h w 3"]
    field: CoarsePicture  # what their mean is multiplied by
    coarse: CoarsePicture  # the product (levels), averaged to the coarse level
    noise: CoarsePicture  # standard deviation (levels) of image minus expected, one full-size pixel
    inliers: Bool[np.ndarray, "hc wc"]  # coarse pixels that look like the plate
    gain: Float32[np.ndarray, " 3"]  # median of the field, RGB


def coarse_size(shape: tuple[int, ...], width: int) -> tuple[int, int]:
    """Returns the image size (px) divided by an integer, which brings the width as near as possible to ``width``."""
    factor = max(1, round(shape[1] / width))
    return max(1, shape[1] // factor), max(1, shape[0] // factor)


def plate_tolerance(levels: Picture) -> Picture:
    """Returns the largest difference (levels) between image and plate that counts as unchanged background."""
    return TOLERANCE_LEVELS + TOLERANCE_SHARE * levels


def estimate_background(
    image: UInt8[np.ndarray, "h w 3"], image_coarse: CoarsePicture, plates: tuple[UInt8[np.ndarray, "_ _ 3"], ...]
) -> Background:
    """Estimates the background of an image with the subject, by fitting a smooth gain field to the clean plates."""
    size = (image_coarse.shape[1], image_coarse.shape[0])
    small = np.stack([cv2.resize(plate, size, interpolation=cv2.INTER_AREA) for plate in plates]).astype(np.float32)
    plate_coarse = small.mean(axis=0)
    few = (slice(None, None, 2), slice(None, None, 2))  # a histogram and a median need no more
    gain = np.array(
        [_mode_of_ratio(image_coarse[few][:, :, c], plate_coarse[few][:, :, c]) for c in range(3)], np.float32
    )
    field = np.broadcast_to(gain, plate_coarse.shape)
    tolerance = plate_tolerance(plate_coarse)
    weight = np.zeros(plate_coarse.shape[:2], np.float32)
    for step in range(STEPS):
        # The first steps must let the unknown field pass: 3 % of the level, then less.
        slack = tolerance + plate_coarse * (0.03, 0.015, 0.0, 0.0)[step]
        weight = _tukey(((image_coarse - field * plate_coarse) / slack) ** 2)
        field = _gain_field(image_coarse, plate_coarse, weight, FIELD_SHARE * size[0])
    inliers = weight > 0.3
    stack = np.stack(plates)
    noise = _noise_by_level(image, stack, field, plate_coarse, inliers)
    noise = _with_temporal_noise(noise, small)
    middle = np.median(field[few][inliers[few]], axis=0) if inliers[few].any() else gain
    return Background(stack, field, field * plate_coarse, noise, inliers, middle.astype(np.float32))


def _mode_of_ratio(image: Float32[np.ndarray, "h w"], plate: Float32[np.ndarray, "h w"]) -> float:
    """Returns the most frequent ratio of image to plate, between a third and three; 1 if too few pixels are usable."""
    usable = (plate > 8) & (image > 4) & (plate < 250) & (image < 250)  # neither black nor clipped
    if usable.sum() < 100:
        return 1.0
    logs = np.log(image[usable] / plate[usable])
    counts, edges = np.histogram(logs, bins=220, range=(-1.1, 1.1))
    smooth = np.convolve(counts, [1, 2, 3, 2, 1], mode="same")
    centre = (edges[:-1] + edges[1:])[np.argmax(smooth)] / 2
    near = logs[np.abs(logs - centre) < 0.04]
    return float(np.exp(np.median(near))) if len(near) else 1.0


def _tukey(square: Picture) -> Float32[np.ndarray, "h w"]:
    """Returns Tukey's biweight of each pixel, for the channel with the largest squared residual."""
    worst = np.maximum(np.maximum(square[:, :, 0], square[:, :, 1]), square[:, :, 2]) / TUKEY**2
    return np.where(worst < 1, (1 - worst) ** 2, 0).astype(np.float32)


def _gain_field(image: Picture, plate: Picture, weight: Float32[np.ndarray, "h w"], sigma: float) -> Picture:
    """Estimates the gain of the image over the plate at each pixel, by least squares in a Gaussian window. Far from
    background pixels the gain tends to that of the whole image."""
    weighted = plate * cv2.merge([weight] * 3)
    size = (max(8, image.shape[1] // 4), max(8, image.shape[0] // 4))  # a smooth field needs no more
    num = cv2.resize(weighted * image, size, interpolation=cv2.INTER_AREA)
    den = cv2.resize(weighted * plate, size, interpolation=cv2.INTER_AREA)
    known = den.mean((0, 1)) > BLACK**2 * weight.mean()  # in a channel that is black, noise divides noise
    whole = np.where(known, num.sum((0, 1)) / np.maximum(den.sum((0, 1)), 1e-6), 1.0)
    ridge = np.where(known, 0.02 * den.mean((0, 1)) + 1e-3, UNKNOWN)
    num, den = (cv2.GaussianBlur(a, (0, 0), max(1.0, sigma / 4), borderType=cv2.BORDER_REPLICATE) for a in (num, den))
    field = (num + ridge * whole) / (den + ridge)
    return cv2.resize(field, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR).astype(np.float32)


def _image_noise(image: UInt8[np.ndarray, "h w 3"], plates: UInt8[np.ndarray, "p h w 3"]) -> Float32[np.ndarray, " 3"]:
    """Estimates the standard deviation (levels) of image minus plate from differences of neighbouring pixels, which
    smooth changes of light do not affect."""
    pairs = [image[::8, x::4].astype(np.float32) - plates[:, ::8, x::4].mean(axis=0) for x in (0, 1)]
    columns = min(pair.shape[1] for pair in pairs)
    steps = pairs[1][:, :columns] - pairs[0][:, :columns]
    return (1.4826 * np.median(np.abs(steps), axis=(0, 1)) / np.sqrt(2)).astype(np.float32) + 0.3


def _noise_by_level(
    image: UInt8[np.ndarray, "h w 3"],
    plates: UInt8[np.ndarray, "p h w 3"],
    field: CoarsePicture,
    plate_coarse: CoarsePicture,
    inliers: Bool[np.ndarray, "hc wc"],
) -> CoarsePicture:
    """Estimates the noise (levels) of every coarse pixel from its brightness. The noise as a function of brightness is
    measured on the background pixels."""
    rows, columns = np.arange(3, image.shape[0], 6), np.arange(3, image.shape[1], 6)  # 20,000 samples are enough
    at = np.ix_(rows * inliers.shape[0] // image.shape[0], columns * inliers.shape[1] // image.shape[1])
    kept = inliers[at]
    wanted = (plates[:, 3::6, 3::6].mean(axis=0, dtype=np.float32) * field[at])[kept]
    residual, level = np.abs(image[3::6, 3::6][kept] - wanted), wanted @ np.full(3, 1 / 3, np.float32)
    which = np.minimum((level * (LEVEL_BINS / 256)).astype(np.int32), LEVEL_BINS - 1)
    centres, curve = [], []
    for k in range(LEVEL_BINS):
        if np.count_nonzero(which == k) >= 200:
            centres.append((k + 0.5) * 256 / LEVEL_BINS)
            curve.append(1.4826 * np.median(residual[which == k], axis=0))
    if not centres:
        return np.broadcast_to(_image_noise(image, plates), plate_coarse.shape).astype(np.float32)
    brightness = plate_coarse @ np.full(3, 1 / 3, np.float32)
    channels = [np.interp(brightness, centres, np.array(curve)[:, c]) for c in range(3)]
    # 8-bit rounding of both images alone is worth sqrt(2 / 12) levels.
    return np.maximum(np.stack(channels, axis=2), np.sqrt(2 / 12)).astype(np.float32)


def _with_temporal_noise(noise: CoarsePicture, plates: Float32[np.ndarray, "p hc wc 3"]) -> CoarsePicture:
    """Adds the variation between the plates, as by a flickering lamp or a moving curtain, if there are at least
    three."""
    if len(plates) < 3:
        return noise
    small = plates / np.maximum(plates.mean(axis=(1, 2), keepdims=True), 1.0)  # changes of exposure are not noise
    spread = small.std(axis=0, ddof=1) * plates.mean()
    return np.sqrt(noise**2 + cv2.blur(spread**2, (3, 3))).astype(np.float32)

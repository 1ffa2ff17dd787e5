"""Computes log odds of subject against background from a pixel's colour, by histograms and by the colours nearby.

Each view has its own background. The subject is the same in all views, but the light may change its colours, so that
its density is half that of all views together and half the view's own. Where both overlap (a grey coat before a grey
wall), the colours nearby are more telling than those of the whole image: a Gaussian of the mean and scatter in a window
is combined with each histogram (Bai et al., *Video SnapCut*, SIGGRAPH 2009, use such local models).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_filter

from pipeline.imaging.masks import spread

BINS = 24  # a channel: 11 levels
HISTOGRAM_BLUR = 0.8  # bins, standard deviation
UNSEEN = 1e-5  # share of a colour that was never seen: unknown, not impossible
NEARBY_PX = 6.0  # of the reduced image: sigma of the window of local colours
MIN_SCATTER = 2.0  # levels: folds and weave of a cloth are no less
SUBJECT_SCATTER = 1.5  # by which the subject's shading is rougher than that
LOG_CELL = 3 * np.log(BINS / 256)  # log of one over a bin's volume, levels^-3
MAX_ODDS = 5.0

Image = Float32[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Holds which pixels of a reduced image certainly show the subject, and which certainly show background."""

    subject: Mask
    background: Mask


def histogram(colours: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "b b b"]:
    """Counts how many pixels fall in each bin of colour."""
    counts = np.zeros((BINS,) * 3, np.float32)
    np.add.at(counts, tuple(_bins(colours).T), 1.0)
    return counts


def colour_odds(
    image: Image,
    samples: Samples,
    common: Float32[np.ndarray, "b b b"],
    noise: Float[np.ndarray, " 3"],
    *,
    nearby: bool,
) -> Float32[np.ndarray, "h w"]:
    """Returns the log odds of subject against background for every pixel, from its colour.

    ``image``: reduced. ``samples``: pixels that are certain. ``common``: counts of the subject's colours in all views.
    ``noise``: grey levels. ``nearby``: whether colours near the pixel count too; they need nearly complete samples.
    """
    subject = _log_density(image, (common, histogram(image[samples.subject])))
    background = _log_density(image, (histogram(image[samples.background]),))
    if nearby:
        scatter = np.maximum(noise, MIN_SCATTER).astype(np.float32)
        subject = np.logaddexp(subject, _log_nearby(image, samples.subject, SUBJECT_SCATTER * scatter)) - np.log(2)
        background = np.logaddexp(background, _log_nearby(image, samples.background, scatter)) - np.log(2)
    return np.clip(subject - background, -MAX_ODDS, MAX_ODDS).astype(np.float32)


def _bins(colours: np.ndarray) -> np.ndarray:
    return np.clip(colours * (BINS / 256), 0, BINS - 1).astype(np.int32)


def _log_density(image: Image, counts: tuple[Float32[np.ndarray, "b b b"], ...]) -> Float[np.ndarray, "h w"]:
    """Returns the log of the mean density (levels^-3) of several histograms at each pixel's colour."""
    density = np.zeros((BINS,) * 3)
    for one in counts:
        smooth = gaussian_filter(one, HISTOGRAM_BLUR, mode="constant")
        density += smooth / max(float(smooth.sum()), 1e-9) / len(counts)
    return np.log(density[tuple(np.moveaxis(_bins(image), 2, 0))] + UNSEEN) + LOG_CELL


def _log_nearby(image: Image, mask: Mask, scatter: Float32[np.ndarray, " 3"]) -> Float[np.ndarray, "h w"]:
    """Returns the log density (levels^-3) of each pixel's colour under a Gaussian fitted to the colours of ``mask``
    near the pixel."""
    weight = mask.astype(np.float32)
    mean, square = spread(image, weight, NEARBY_PX), spread(image * image, weight, NEARBY_PX)
    variance = np.maximum(square - mean * mean, 0) + scatter**2
    return -0.5 * ((image - mean) ** 2 / variance + np.log(2 * np.pi * variance)).sum(axis=2)

"""Decides which pixels show the subject, in a reduced image, in which averaging reduces the noise to a quarter.

The module computes each pixel's log odds of foreground against the corrected background
(``pipeline.segmentation.background``), and smooths them by mean-field sweeps. Neighbours are coupled weakly where their
*differences* to the plate differ (Sun et al., *Background Cut*, ECCV 2006), so edges of the backdrop have no effect. A
pixel similar to the plate is certainly background only if the subject has another colour (``Decision.clear``). Other
pixels similar to the plate are doubtful, as are pixels where a shadow might be a coat. For doubtful pixels,
``pipeline.segmentation.segment`` uses the other cameras, and ``reconsider`` decides again.

Soft shadows on the backdrop, and light that the subject reflects onto the backdrop, count as background.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from pipeline.imaging.colour_chart import empty_plates
from pipeline.imaging.masks import dilate, erode, spread
from pipeline.segmentation.background import (
    ANY_COLOUR_ODDS,
    CHANNEL_SUM,
    COARSE_COLUMNS,
    Background,
    coarse_size,
    estimate_background,
    plate_tolerance,
)
from pipeline.segmentation.mask_kernels import MAX_ODDS, mean_field_sweeps

DARKEST_SHADOW = 0.55  # share of the sRGB code that a soft shadow leaves (a quarter of the light)
SHADOW_CHROMA = 0.05  # how far a shadow's colour may be from the plate's, by the light it takes
SHADOW_CHI2 = 11.3  # three channels, 99 %: what still counts as a darker piece of the plate
STEEP = 0.03  # change of a shadow's depth a coarse pixel; blurred by 7 of them, as in the tests, a shadow has 0.016
BRIGHTEST = 0.12  # share of the sRGB code that reflected light adds; 0.09 on the wall above an oily bald head
REFLECTED_CHROMA = 0.3  # how far its colour may be from the plate's: it is the subject's
SOFT_ONSET = 0.15  # depth of a shadow 2 coarse pixels before it is noticed by that 2 behind; at a sharp edge 0 to 0.06

SMOOTHNESS = 1.0  # log odds that a neighbour of the same kind is worth
SWEEPS = 12  # of the mean field; the masks of the tests do not change after the eighth

MAX_HOLE_SHARE = 0.02  # of the subject: smaller holes that are not quite the plate are filled
CLOSING = 2  # coarse pixels
CONCLUSIVE = 10.0  # standard deviations between plate and subject's colour at which a look of the plate is proof
SHADES = 0.35, 1.15  # by which the subject's colour may be darker (in codes; a tenth of the light) or brighter nearby
PAINT_ODDS = 4.4  # log odds that the free choice of the shade costs: 1 % of brightness, the noise, out of 80 %
ALLOWED, DENIED = 4.0, 3.0  # log odds for a pixel that no other camera denies, and against one that three deny
PALETTE = 16  # bins a channel of the subject's colours
ANY_LEVELS = 64  # a channel: the spread of any colour at all, as in ANY_COLOUR_ODDS
REACH = 24  # coarse pixels from the mask in which a doubtful pixel may still be the subject
MAX_PLATE_CHI2 = 3.0  # chi-squared by its median over the background, up to which a pixel is the plate: 93 % of it are
HAIR_DEPTH = 6  # coarse pixels (24 px)
NOISE_HOLE_COARSE_PX = 3  # coarse pixels: a hole of this size is noise wherever it is
MIXED = 0.1  # of the difference to the plate: standard deviation within a coarse pixel from which it is a mixture
MIXED_SINGLE = 0.2  # the same where a quarter of the coarse pixel is one pixel, whose noise nothing averages
STRAND_SHADES = 0.75, 1.0, 1.33  # of the subject's colour nearby, in which strands before the plate may be
MAX_FAINT_CHI2 = 100.0  # chi-squared of a mean over nine pixels
UNEXPLAINED, UNEXPLAINED_SHARE = 8.0, 0.15  # chi-squared that a mixture must leave, and that by the whole
Picture = Float32[np.ndarray, "h w 3"]
Plane = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Holds which pixels of a single image show subject or background. All arrays have the size of the reduced image;
    without a subject the mask is empty."""

    coarse: Picture  # the image
    background: Background
    odds: Plane  # of subject against plate, clipped
    probability: Float[np.ndarray, "h w"]
    mask: Mask  # the subject's one piece, with what a person would fill
    detached_component_areas: tuple[float, ...]  # areas of the other pieces by its own
    paint: Picture  # the subject's own colour nearby
    own_odds: Plane  # of the subject's own colours, rather than any, against the plate
    clear: Mask  # that is nothing like the plate, in any shade
    plain: Mask  # and what is seen there is exactly the plate
    mixed: Mask  # hair before the plate, or an edge

    @property
    def reduction(self) -> float:
        """Returns the width of a coarse pixel, in pixels of the image."""
        return self.background.plates.shape[2] / self.mask.shape[1]


def decide(image: UInt8[np.ndarray, "_ _ 3"], plates: tuple[UInt8[np.ndarray, "_ _ 3"], ...]) -> Decision:
    """Decides which pixels of one image show the subject, by a comparison with its clean plates in reduced size."""
    size = coarse_size(image.shape, COARSE_COLUMNS)
    coarse = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    background = estimate_background(image, coarse, empty_plates(plates))
    chi2, variance = _against_plate(coarse, background, image.shape[1] / size[0])
    odds = np.clip(0.5 * chi2 - ANY_COLOUR_ODDS, -MAX_ODDS, MAX_ODDS)
    chi2, shadow = find_shadows(coarse, background.coarse, chi2, variance, odds)
    odds = np.where(shadow, -MAX_ODDS / 2, odds).astype(np.float32)
    probability = smooth_odds(odds, coarse, background)
    raw = probability > 0.5
    away, mixture = find_mixtures(image, coarse, background)
    paint = spread(coarse, erode(raw, 1) * away / (1 + mixture**2), 2.0)
    clear = colours_apart(paint, background.coarse, variance) > CONCLUSIVE
    other, unexplained = _other_colour(coarse - background.coarse, paint, background.coarse, variance)
    clear &= ~dilate(other, 1)
    plain = (
        clear & (chi2 < MAX_PLATE_CHI2 * np.median(chi2[background.inliers]))
        if background.inliers.any()
        else clear & False
    )
    mask, detached_component_areas = whole_subject(raw, plain)
    mixed = (mixture > 1) & (away > (2 * background.noise @ CHANNEL_SUM / 3) ** 2)
    own_odds = _subject_colour_odds(coarse, raw, paint, chi2, variance)
    own_odds = np.where(other, np.maximum(own_odds, 0.5 * unexplained - ANY_COLOUR_ODDS), own_odds)
    return Decision(
        coarse, background, odds, probability, mask, detached_component_areas, paint, own_odds, clear, plain, mixed
    )


def doubtful(decision: Decision) -> Mask:
    """Returns a mask of pixels outside the subject's mask that might show the subject: pixels near it where subject and
    plate look alike. The other cameras decide about such pixels."""
    near = dilate(decision.mask, REACH) & ~decision.mask
    return near & ~decision.clear & (decision.own_odds > -ALLOWED)


def reconsider(decision: Decision, dissent: Int[np.ndarray, "h w"]) -> Decision:
    """Revises the decision about doubtful pixels by means of the other cameras. ``dissent`` is, for each doubtful
    pixel, the number of cameras that exclude the subject; it is negative at all other pixels."""
    prior = np.where(dissent == 0, ALLOWED, np.where(dissent >= 3, -DENIED, 0.0))
    revised = np.clip(np.maximum(decision.odds, decision.own_odds) + prior, -MAX_ODDS, MAX_ODDS)
    odds = np.where(dissent >= 0, revised, decision.odds).astype(np.float32)
    probability = smooth_odds(odds, decision.coarse, decision.background)
    mask, detached_component_areas = whole_subject(probability > 0.5, decision.plain)
    return replace(
        decision, odds=odds, probability=probability, mask=mask, detached_component_areas=detached_component_areas
    )


def _subject_colour_odds(image: Picture, mask: Mask, paint: Picture, chi2: Plane, variance: Picture) -> Plane:
    """Returns the log odds that a pixel has a colour of the subject instead of the plate's. Candidates are the
    subject's colour nearby, scaled to the best brightness, and all colours inside the mask."""
    nearby = 0.5 * (chi2 - colours_apart(paint, image, variance) ** 2) - PAINT_ODDS
    bins = (image / (256 / PALETTE)).astype(np.int32).clip(0, PALETTE - 1)
    counts = np.zeros((PALETTE,) * 3, np.float32)
    np.add.at(counts, tuple(bins[erode(mask, 1)].T), 1.0)
    for axis in range(3):
        low, high = (np.roll(counts, step, axis) for step in (1, -1))
        counts = 0.5 * counts + 0.25 * (low + high)
    share = counts / max(float(counts.sum()), 1.0) * (PALETTE * ANY_LEVELS / 256) ** 3  # density by that of any colour
    gain = np.log(np.maximum(share[tuple(np.moveaxis(bins, 2, 0))], 1.0))
    return np.maximum(nearby, 0.5 * chi2 - ANY_COLOUR_ODDS + gain)


def find_mixtures(image: UInt8[np.ndarray, "_ _ 3"], coarse: Picture, background: Background) -> tuple[Plane, Plane]:
    """Returns the squared difference of each coarse pixel from the plate (mean over the channels). The function also
    returns how much the pixel mixes subject and plate, as strands of hair do: the variance of its four quarters
    relative to this difference. The measure does not depend on the picture's size."""
    size = coarse.shape[1::-1]
    averaged = 2 * size[0] < image.shape[1]
    quarters = _quarters(image, (2 * size[0], 2 * size[1]))
    square = cv2.resize(quarters * quarters, size, interpolation=cv2.INTER_AREA)
    third = CHANNEL_SUM / 3
    sigma = background.noise @ third * min(2 * size[0] / image.shape[1], 1.0)
    within = np.maximum((square - coarse**2) @ third - sigma**2, 0.0)
    away = ((coarse - background.coarse) ** 2) @ third
    least = MIXED if averaged else MIXED_SINGLE
    return away, within / (least**2 * away + 1e-6)


def _quarters(image: UInt8[np.ndarray, "_ _ 3"], size: tuple[int, int]) -> Float32[np.ndarray, "_ _ 3"]:
    """Scales an image to ``size`` (width, height), two pixels for each coarse pixel in both directions: by area means,
    or by interpolation if the image is smaller."""
    method = cv2.INTER_AREA if size[0] <= image.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(image, size, interpolation=method).astype(np.float32)


def _against_plate(image: Picture, background: Background, reduction: float) -> tuple[Plane, Picture]:
    """Returns the chi-squared of a coarse image against the plate, and the variance (levels squared) of their
    difference."""
    difference = image - background.coarse
    measured = 1.4826 * np.median(np.abs(difference[background.inliers]), axis=0) if background.inliers.any() else 0.0
    noise = np.maximum(background.noise / reduction, measured)  # JPEG and demosaicing leave noise that does not average
    tolerance = plate_tolerance(background.coarse)
    variance = (noise**2 + tolerance**2).astype(np.float32)
    return (difference**2 / variance) @ CHANNEL_SUM, variance


def colours_apart(colour: Picture, other: Picture, variance: Picture) -> Plane:
    """Returns the distance (standard deviations) between two colours, after ``colour`` is scaled to the brightness
    nearest to ``other``."""
    sigma = np.sqrt(variance)
    f, b = colour / sigma, other / sigma
    shade = np.clip(((f * b) @ CHANNEL_SUM) / np.maximum((f * f) @ CHANNEL_SUM, 1e-6), *SHADES)
    return np.sqrt(((shade[:, :, None] * f - b) ** 2) @ CHANNEL_SUM)


def _other_colour(difference: Picture, paint: Picture, plate: Picture, variance: Picture) -> tuple[Mask, Plane]:
    """Finds faint differences to the plate that neither a shadow nor a mixture with the subject's colour nearby
    (``paint``) explains. The function also returns the remaining chi-squared, averaged over nine pixels."""
    weight = 3 / variance  # of a mean over nine pixels, whose errors are not all their own
    faint = ((difference**2 * weight) @ CHANNEL_SUM < MAX_FAINT_CHI2).astype(np.float32)
    mean = cv2.blur(difference * faint[:, :, None], (3, 3)) / np.maximum(cv2.blur(faint, (3, 3)), 0.1)[:, :, None]
    square = (mean**2 * weight) @ CHANNEL_SUM
    left = square
    mixtures = [(shade * paint - plate, 1.0) for shade in STRAND_SHADES]
    for direction, most in ((-plate, 1 - DARKEST_SHADOW), *mixtures):
        along, whole = (mean * direction * weight) @ CHANNEL_SUM, (direction**2 * weight) @ CHANNEL_SUM
        share = np.clip(along / np.maximum(whole, 1e-6), 0, most)
        left = np.minimum(left, square + share * (share * whole - 2 * along))
    return (left > UNEXPLAINED + UNEXPLAINED_SHARE * square) & (faint > 0), left


def _closed(mask: Mask) -> Mask:
    """Closes gaps of up to four coarse pixels in the mask. The matting opens real gaps again, for example between locks
    of hair, unless the subject has the backdrop's colour."""
    padded = np.pad(mask, CLOSING, mode="edge")
    return erode(dilate(padded, CLOSING), CLOSING)[CLOSING:-CLOSING, CLOSING:-CLOSING]


def whole_subject(mask: Mask, plain: Mask) -> tuple[Mask, tuple[float, ...]]:
    """Returns the largest component of the mask with small gaps and holes filled, and the areas of the other components
    relative to it."""
    mask = mask | (_closed(mask) & ~plain)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask), ()
    areas = stats[1:, cv2.CC_STAT_AREA]
    main = int(np.argmax(areas)) + 1
    subject = labels == main
    others = sorted((float(a) / float(areas[main - 1]) for k, a in enumerate(areas, 1) if k != main), reverse=True)
    count, found, stats, _ = cv2.connectedComponentsWithStats((~subject).view(np.uint8), connectivity=4)
    holes = np.asarray(found, np.int32)
    size = stats[:, cv2.CC_STAT_AREA]
    # A gap between hair and shoulder shows the plate where nothing of the subject is like it. Far inside the outline
    # there are few gaps, and something small of the subject may look like the plate by chance.
    small = size < MAX_HOLE_SHARE * subject.sum()
    inner = np.bincount(holes[erode(subject | small[holes], HAIR_DEPTH)], minlength=count) > 0.5 * size
    shown = np.bincount(holes[plain], minlength=count) / size
    gap = (shown > 0.5) & ~(inner & (size <= NOISE_HOLE_COARSE_PX))
    filled = small & ~gap
    filled[0] = False
    return subject | filled[holes], tuple(others)


def smooth_odds(odds: Plane, image: Picture, background: Background) -> Float[np.ndarray, "h w"]:
    """Returns the probability of the subject at each pixel after mean-field smoothing, in which neighbours with similar
    residuals influence each other."""
    residual = ((image - background.coarse) / np.maximum(background.noise, 1.0)).astype(np.float32)
    field = mean_field_sweeps(np.asarray(odds, np.float32), residual, SMOOTHNESS, SWEEPS)
    return 1 / (1 + np.exp(-2 * field))


def find_shadows(image: Picture, plate: Picture, chi2: Plane, variance: Picture, odds: Plane) -> tuple[Plane, Mask]:
    """Returns the chi-squared of each pixel against the plate scaled to the best brightness, and a mask of soft shadows
    and reflected light. Shadows and reflected light differ from the plate only in brightness, and the difference begins
    gradually."""
    ratio = ((image * plate / variance) @ CHANNEL_SUM) / np.maximum((plate**2 / variance) @ CHANNEL_SUM, 1e-6)
    strength = np.sqrt(chi2 / (2 * ANY_COLOUR_ODDS))
    best, soft = chi2, np.zeros(odds.shape, bool)
    for sign, most, chroma in ((-1.0, 1 - DARKEST_SHADOW, SHADOW_CHROMA), (1.0, BRIGHTEST, REFLECTED_CHROMA)):
        depth = np.clip(sign * (ratio - 1), 0.0, most).astype(np.float32)
        slack = variance + (chroma * depth[:, :, None] * plate) ** 2
        left = (((image - (1 + sign * depth)[:, :, None] * plate) ** 2 / slack) @ CHANNEL_SUM).astype(np.float32)
        found = _soft_shadows((left < SHADOW_CHI2) & (depth > 0) & (odds > 0), depth, strength)
        best, soft = np.where(found, left, best), soft | found
    return best, soft


def _soft_shadows(candidate: Mask, depth: Plane, strength: Plane) -> Mask:
    """Returns the candidates that begin gradually, next to background that is already darker. A coat begins abruptly,
    even within a shadow, and is left out.

    ``strength`` is the difference to the plate; 1 is the smallest detectable difference.
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
    return found | (fringe & dilate(found, 3))


def _means(values: Plane, where: Mask, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean value of each connected component over the pixels ``where``, and the number of these pixels."""
    sizes = np.bincount(labels[where], minlength=count)
    return np.bincount(labels[where], values[where], count) / np.maximum(sizes, 1), sizes

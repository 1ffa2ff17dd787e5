"""Finds a sub-pixel contour from a coarse mask: estimates the alpha of pixels in a band around the mask's outline.

The background B of every pixel is known, and the subject's colour F is taken from pixels just inside the mask. In
linear light a pixel is ``I = q F + (1 - alpha) B``. The factor q is alpha times the local brightness of the subject,
which darkens where its surface turns away from the camera. Least squares over the channels, with q close to alpha,
gives alpha. The contour is where alpha is one half, which is the position of the edge under any symmetric blur.

Colours are mixed in linear light; with sRGB codes the contour of dark hair was 0.25 px too far inside. Without q, the
contour of cheeks, which darken towards their edge, was 0.2 px too far inside. The background B is first matched to the
pixels just outside the mask, so that a shadow or reflected light at the edge does not shift the contour. The colour F
may vary (a dark edge, a lock of hair), so it is estimated again inside the first contour. If the colours are too
similar, alpha follows the coarse mask.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.imaging.masks import box_around, dilate, erode, spread
from pipeline.segmentation.background import Background
from pipeline.segmentation.foreground import Decision
from pipeline.segmentation.mask_kernels import MAX_ALPHA_INFORMATION, solve_alpha
from rig.colour_space import linear_from_srgb

Plane = Float32[np.ndarray, "h w"]

BAND_PX = 6.0  # half width of the band in which alpha is solved, beyond the coarse level's 4 px
ALPHA_BLUR_PX = 0.7  # blur that optics and pixel give an edge anyway; it halves the noise of the contour
WEAK_CONTRAST = 4.0  # standard deviations between subject and background below which a contour piece is weak
FULL_REDUCTION = 3  # pixels to a coarse one, for which the distances in pixels below were chosen
INSIDE_PX = 3  # the subject's colour is taken this far inside the first contour: beyond the blur of an edge (3 sigma)
SOLID = 0.85  # alpha above which a pixel shows the subject's own colour, and not hair before the background
WINDOW_PX = 3.0  # sigma of the window it is averaged in
DEPTH = 6  # bands inside the outline up to which a gap before the plate is looked for: 48 px
COARSE_ALPHA_SIGMA = 1.0  # standard deviation of alpha at which the coarse mask counts as much as the pixel
LINEAR = (255 * linear_from_srgb(np.arange(257) / 255.0)).astype(np.float32)  # by code, one more to interpolate to
SHADE = 0.08  # standard deviation of the subject's brightness at the rim, of full alpha: surfaces darken as they turn
# away
WIDE_PX = 2.5  # sigma of that window
MARGIN_PX = 12  # around the band: beyond every window here and in what follows


@dataclass(frozen=True, slots=True, eq=False)
class Matte:
    """Holds the subject's alpha (about 0 to 1, smoothed) in a box of the image, and the contrast to the background
    along the contour."""

    alpha: Float32[np.ndarray, "hb wb"]
    box: tuple[slice, slice]  # rows and columns of the image; a margin without subject but at the image's own border
    contrast: Float32[np.ndarray, " c"]  # |F - B| in standard deviations, at every pixel of the contour; 0 where
    # alpha was not solved beside it either
    unsure: float  # share of the contour that has little contrast, or lies beside what was not solved


def solve_matte(image: UInt8[np.ndarray, "h w 3"], decision: Decision) -> Matte:
    """Computes the subject's alpha from a coarse decision.

    Where the subject's colour differs clearly from the plate, alpha is solved in a band that is wide enough for thin
    hair. Where the colours are similar, alpha follows the coarse decision, and is solved only at its border.
    """
    background, mask, clear = decision.background, decision.mask, decision.clear
    probability = np.where(mask, np.maximum(decision.probability, 0.6), np.minimum(decision.probability, 0.4))
    band = int(np.ceil(BAND_PX / max(decision.reduction, FULL_REDUCTION)))
    undecided = dilate(mask, 2) & ~erode(mask, 2)
    undecided |= dilate(decision.mixed, 1) & dilate(mask, band) & ~erode(mask, DEPTH * band)
    undecided &= clear | (dilate(mask, 1) & ~erode(mask, 1))
    zone = np.where(undecided, np.where(clear, 1, 3), 2 * mask).astype(np.uint8)
    cells = box_around(zone > 0, int(np.ceil(MARGIN_PX / decision.reduction)))
    box = _pixels(cells, zone.shape, image.shape)
    light = (background.field * _light_outside(decision.coarse, background, mask))[cells]
    sigma = background.noise[cells] @ np.full(3, 1 / 3, np.float32)
    cropped = image[box]
    paint = np.ascontiguousarray(decision.paint[cells])  # as the better guess is: one loop is compiled for both
    plates, zones, guess = background.plates[:, *box], zone[cells], probability[cells].astype(np.float32)
    widths = (COARSE_ALPHA_SIGMA, SHADE)
    alpha, _, _ = solve_alpha(LINEAR, cropped, plates, light, sigma, zones, guess, paint, widths, True)
    alpha = cv2.GaussianBlur(alpha, (0, 0), ALPHA_BLUR_PX)
    better = _subject_inside(cropped, alpha, paint, decision.reduction)
    alpha, contrast, trust = solve_alpha(LINEAR, cropped, plates, light, sigma, zones, guess, better, widths, False)
    alpha = _smooth(alpha, trust, ALPHA_BLUR_PX)
    unsolved = dilate(contrast < 0, 1) if decision.reduction >= FULL_REDUCTION else contrast < 0
    little = (contrast < WEAK_CONTRAST) | unsolved
    edge = np.abs(alpha - 0.5) < 0.25
    unsure = float(little[edge].mean()) if edge.any() else 0.0
    return Matte(alpha, box, _along_contour(contrast, alpha), unsure)


def _pixels(cells: tuple[slice, slice], coarse: tuple[int, ...], fine: tuple[int, ...]) -> tuple[slice, slice]:
    """Returns the slices of image rows and columns that a range of coarse rows and columns covers."""
    rows, columns = (
        slice(round(part.start * many / few), round(part.stop * many / few))
        for part, few, many in zip(cells, coarse, fine, strict=False)
    )
    return rows, columns


def _smooth(alpha: Plane, trust: Plane, sigma: float) -> Plane:
    """Smooths alpha with the weights ``trust`` (1 / variance), in a window that is wider where ``trust`` is low."""
    near = cv2.GaussianBlur(alpha, (0, 0), sigma)
    if not (trust < MAX_ALPHA_INFORMATION).any():
        return near
    weight = cv2.GaussianBlur(trust, (0, 0), WIDE_PX)
    far = cv2.GaussianBlur(trust * alpha, (0, 0), WIDE_PX) / weight
    share = np.clip(2 - 2 * weight / MAX_ALPHA_INFORMATION, 0, 1)
    return near + share * (far - near)


def _light_outside(
    image: Float32[np.ndarray, "h w 3"], background: Background, mask: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Returns the ratio of the image to the estimated background just outside the subject, extended to all pixels."""
    clear = ~dilate(mask, 2)
    if not clear.any():
        return np.ones_like(image)
    both = spread(np.concatenate([image, background.coarse], axis=2), clear.astype(np.float32), 2.5)
    return np.clip(both[:, :, :3] / np.maximum(both[:, :, 3:], 4.0), 0.3, 1.5)


def _subject_inside(
    image: UInt8[np.ndarray, "h w 3"], alpha: Plane, coarse: Float32[np.ndarray, "hc wc 3"], reduction: float
) -> Float32[np.ndarray, "h2 w2 3"]:
    """Returns the subject's colour near its contour, at half resolution, extended outwards from certain pixels inside.
    Distances are proportional to the size of a coarse pixel, if it is below ``FULL_REDUCTION`` pixels of the
    picture."""
    share = min(reduction / FULL_REDUCTION, 1.0)
    step = 2 if share == 1 else 1
    size = (image.shape[1] // step, image.shape[0] // step)
    inner = erode(alpha > 0.5, max(2, int(np.ceil(INSIDE_PX * share)))) & (alpha > SOLID)
    sure = cv2.resize(255 * inner.view(np.uint8), size, interpolation=cv2.INTER_AREA) == 255
    colours = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    known = cv2.copyTo(cv2.cvtColor(colours, cv2.COLOR_RGB2RGBA), sure.view(np.uint8))  # 255 in the fourth channel
    total = cv2.GaussianBlur(known.astype(np.float32), (0, 0), WINDOW_PX * share / step)
    found = cv2.cvtColor(total, cv2.COLOR_RGBA2RGB) + 0.02 * cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
    return found / cv2.cvtColor(total[:, :, 3] / 255 + np.float32(0.02), cv2.COLOR_GRAY2RGB)


def _along_contour(contrast: Plane, alpha: Plane) -> Float32[np.ndarray, " c"]:
    """Returns the contrast at every pixel of the contour. Pixels outside the solved band get their neighbours'
    contrast, or 0 if the neighbours are not solved either."""
    mask = alpha > 0.5
    nearby = np.where(contrast < 0, cv2.dilate(contrast, np.ones((3, 3), np.uint8)), contrast)
    return np.maximum(nearby, np.float32(0))[mask & ~erode(mask, 1)]

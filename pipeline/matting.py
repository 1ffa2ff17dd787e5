"""From a coarse mask to a sub-pixel contour: alpha in a band around it.

With the background B of every pixel known, and the subject's colour F taken from just inside, a pixel is
``I = q F + (1 - alpha) B`` in linear light, q being alpha times the local shade of the subject, which darkens where it
turns away from the camera; least squares over the channels with q close to alpha gives alpha, and the contour is where
alpha is one half, which for an edge blurred by any symmetric optics is where the edge is. Light adds up, its sRGB codes
do not: with codes the contour of dark hair was 0.25 px too far in, on captures rendered by another program; without q
that of cheeks, which end in their own shade, was 0.2 px too far in.

B is first matched to the pixels just outside, so that a shadow or bounced light at the edge does not move it; F, which
may vary (a dark rim, a lock of hair), is taken again from inside the first contour. Where the colours are too close to
tell, alpha leans on the coarse mask.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numba import njit

from pipeline.background import Background
from pipeline.coarse import Decision
from pipeline.regions import box_around, dilated, eroded, spread
from pipeline.settings import SegmentationSettings
from rig.mesh_files import linear_from_srgb

INSIDE_PX = 3  # the subject's colour is taken this far inside the first contour: beyond the blur of an edge (3 sigma)
SOLID = 0.85  # alpha above which a pixel shows the subject's own colour, and not hair before the background
WINDOW_PX = 3.0  # sigma of the window it is averaged in
DEPTH = 6  # bands inside the outline up to which a gap before the plate is looked for: 48 px
LEAN = 1.0  # standard deviation of alpha at which the coarse mask counts as much as the pixel
LINEAR = (255 * linear_from_srgb(np.arange(257) / 255.0)).astype(np.float32)  # by code, one more to interpolate to
SHADE = (
    0.08  # standard deviation of the subject's brightness at the rim, of full alpha: surfaces darken as they turn away
)
OTHER = 10.0  # log odds that a pixel must show against every mixture before it is taken for another colour
FAINT = 25.0  # 1 / variance of one pixel's alpha, below which it is averaged in a wider window
WIDE_PX = 2.5  # sigma of that window
MARGIN_PX = 12  # around the band: beyond every window here and in what follows


@dataclass(frozen=True, slots=True, eq=False)
class Matte:
    """Alpha (about 0 to 1, smoothed) in the box that holds the subject, and how far it stands out along its contour."""

    alpha: Float32[np.ndarray, "hb wb"]
    box: tuple[slice, slice]  # rows and columns of the image; a margin without subject but at the image's own border
    contrast: Float32[np.ndarray, " c"]  # |F - B| in standard deviations, at every pixel of the contour; 0 where the
    # coarse mask alone put it


def solve_matte(image: UInt8[np.ndarray, "h w 3"], decision: Decision, settings: SegmentationSettings) -> Matte:
    """Alpha of the subject that was decided upon.

    Where its colour is nothing like the plate, pixels are asked in a band that is wide enough for hair, which is sparse
    far inside its outline. Elsewhere the decision, which has seen more pixels, is believed but for its border.
    """
    background, mask, clear = decision.background, decision.mask, decision.clear
    probability = np.where(mask, np.maximum(decision.probability, 0.6), np.minimum(decision.probability, 0.4))
    band = int(np.ceil(settings.band_px / decision.reduction))
    asked = dilated(mask, 2) & ~eroded(mask, 2)
    asked |= dilated(decision.mixed, 1) & dilated(mask, band) & ~eroded(mask, DEPTH * band)
    asked &= clear | (dilated(mask, 1) & ~eroded(mask, 1))
    zone = np.where(asked, np.where(clear, 1, 3), 2 * mask).astype(np.uint8)
    cells = box_around(zone > 0, int(np.ceil(MARGIN_PX / decision.reduction)))
    box = _pixels(cells, zone.shape, image.shape)
    light = (background.field * _light_outside(decision.coarse, background, mask))[cells]
    sigma = background.noise[cells] @ np.full(3, 1 / 3, np.float32)
    own, paint = image[box], decision.paint[cells]
    args = (LINEAR, own, background.plates[:, *box], light, sigma, zone[cells], probability[cells].astype(np.float32))
    alpha, _, _ = _alpha(*args, paint, LEAN, SHADE, True)
    alpha = cv2.GaussianBlur(alpha, (0, 0), settings.alpha_blur_px)
    alpha, contrast, trust = _alpha(*args, _subject_inside(own, alpha, paint), LEAN, SHADE, False)
    alpha = _smooth(alpha, trust, settings.alpha_blur_px)
    unasked = dilated(contrast < 0, 1)
    return Matte(alpha, box, np.where(unasked, np.float32(0), contrast)[np.abs(alpha - 0.5) < 0.25])


def _pixels(cells: tuple[slice, slice], coarse: tuple[int, ...], fine: tuple[int, ...]) -> tuple[slice, slice]:
    """The image's part that a part of the coarse level covers."""
    rows, columns = (
        slice(round(part.start * many / few), round(part.stop * many / few))
        for part, few, many in zip(cells, coarse, fine, strict=False)
    )
    return rows, columns


def _smooth(
    alpha: Float32[np.ndarray, "h w"], trust: Float32[np.ndarray, "h w"], sigma: float
) -> Float32[np.ndarray, "h w"]:
    """Alpha averaged by ``trust`` (1 / variance), in a window that is wider where it is low."""
    near = cv2.GaussianBlur(alpha, (0, 0), sigma)
    if not (trust < FAINT).any():
        return near
    weight = cv2.GaussianBlur(trust, (0, 0), WIDE_PX)
    far = cv2.GaussianBlur(trust * alpha, (0, 0), WIDE_PX) / weight
    share = np.clip(2 - 2 * weight / FAINT, 0, 1)
    return near + share * (far - near)


def _light_outside(
    image: Float32[np.ndarray, "h w 3"], background: Background, mask: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """What the background just outside shines like, by what was expected of it."""
    clear = ~dilated(mask, 2)
    if not clear.any():
        return np.ones_like(image)
    both = spread(np.concatenate([image, background.coarse], axis=2), clear.astype(np.float32), 2.5)
    return np.clip(both[:, :, :3] / np.maximum(both[:, :, 3:], 4.0), 0.3, 1.5)


def _subject_inside(
    image: UInt8[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"], coarse: Float32[np.ndarray, "hc wc 3"]
) -> Float32[np.ndarray, "h2 w2 3"]:
    """The subject's colour near its contour, at half resolution."""
    half = (image.shape[1] // 2, image.shape[0] // 2)
    inner = eroded(alpha > 0.5, INSIDE_PX) & (alpha > SOLID)
    sure = cv2.resize(255 * inner.view(np.uint8), half, interpolation=cv2.INTER_AREA) == 255
    colours = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
    known = cv2.copyTo(cv2.cvtColor(colours, cv2.COLOR_RGB2RGBA), sure.view(np.uint8))  # 255 in the fourth channel
    total = cv2.GaussianBlur(known.astype(np.float32), (0, 0), WINDOW_PX / 2)
    found = cv2.cvtColor(total, cv2.COLOR_RGBA2RGB) + 0.02 * cv2.resize(coarse, half, interpolation=cv2.INTER_LINEAR)
    return found / cv2.cvtColor(total[:, :, 3] / 255 + np.float32(0.02), cv2.COLOR_GRAY2RGB)


@njit(cache=True, nogil=True, inline="always")
def _corner(x: int, size: int, small: int) -> tuple[int, float]:
    """Cell and fraction for linear interpolation between pixel centres of a smaller image."""
    at = min(max((x + 0.5) * small / size - 0.5, 0.0), small - 1.0)
    low = min(int(at), max(small - 2, 0))
    return low, at - low


@njit(cache=True, nogil=True, inline="always")
def _between(a: np.ndarray, y: int, x: int, c: int, fy: float, fx: float) -> float:
    top = a[y, x, c] + fx * (a[y, x + 1, c] - a[y, x, c])
    low = a[y + 1, x, c] + fx * (a[y + 1, x + 1, c] - a[y + 1, x, c])
    return top + fy * (low - top)


@njit(cache=True, nogil=True, inline="always")
def _decoded(table: np.ndarray, code: float) -> float:
    code = min(max(code, 0.0), 255.0)
    low = int(code)
    return table[low] + (code - low) * (table[low + 1] - table[low])


@njit(cache=True, nogil=True, fastmath=True)
def _alpha(
    table: np.ndarray,
    image: np.ndarray,
    plates: np.ndarray,
    light: np.ndarray,
    sigma: np.ndarray,
    zone: np.ndarray,
    probability: np.ndarray,
    subject: np.ndarray,
    lean: float,
    shade: float,
    first: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Alpha (-0.5 to 1.5) of every pixel, and in the band |F - B| in standard deviations of the image's noise (-1
    elsewhere) and 1 / variance of alpha (1 elsewhere).

    ``zone``: 0 outside, 1 band, 2 inside, 3 band in which the first guess of the subject's colour is no help.
    """
    height, width = image.shape[:2]
    ch, cw = zone.shape
    columns = np.minimum(np.arange(width) * cw // width, cw - 1)
    alpha = np.empty((height, width), np.float32)
    contrast = np.full((height, width), -1.0, np.float32)
    trust = np.full((height, width), FAINT, np.float32)
    for y in range(height):
        zy = min(y * ch // height, ch - 1)
        ly, fly = _corner(y, height, ch)
        sy, fsy = _corner(y, height, subject.shape[0])
        for x in range(width):
            zx = columns[x]
            kind = zone[zy, zx]
            if kind == 0 or kind == 2:
                alpha[y, x] = 0.0 if kind == 0 else 1.0
                continue
            lx, flx = _corner(x, width, cw)
            p00, p01 = probability[ly, lx], probability[ly, lx + 1]
            p10, p11 = probability[ly + 1, lx], probability[ly + 1, lx + 1]
            prior = (1 - fly) * (p00 + flx * (p01 - p00)) + fly * (p10 + flx * (p11 - p10))
            if first and kind == 3:
                alpha[y, x] = prior
                continue
            sx, fsx = _corner(x, width, subject.shape[1])
            noise = sigma[zy, zx]
            ff, fb, bb, df, db, dd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # sums in standard deviations
            for c in range(3):
                b = 0.0
                for k in range(len(plates)):
                    b += plates[k, y, x, c]
                b *= _between(light, ly, lx, c, fly, flx) / len(plates)
                f = _between(subject, sy, sx, c, fsy, fsx)
                code = min(int(0.5 * (f + b)), 255)
                scale = 1 / ((table[code + 1] - table[code]) * noise)
                b, f, i = scale * _decoded(table, b), scale * _decoded(table, f), scale * table[image[y, x, c]]
                ff += f * f
                fb += f * b
                bb += b * b
                df += (i - b) * f
                db += (i - b) * b
                dd += (i - b) * (i - b)
            # Normal equations of I - B = q F - alpha B, with q = alpha (within shade) and alpha = prior (within LEAN).
            m11, m12, m22 = ff + 1 / shade**2, -fb - 1 / shade**2, bb + 1 / shade**2 + 1 / lean**2
            r1, r2 = df, -db + prior / lean**2
            determinant = m11 * m22 - m12 * m12
            value = (m11 * r2 - m12 * r1) / determinant
            square = ff - 2 * fb + bb
            value = min(1.5, max(-0.5, value))  # wide, because clipping noise at 0 and 1 would bend the ramp
            if (
                first
            ):  # what no mixture of the two explains, in any shade of the plate, is another colour of the subject
                a = min(1.0, max(0.0, value))
                left = dd - 2 * a * (df - db) + a * a * square
                along = min(0.0, max(-0.4 * (1 - a), (db - a * (fb - bb)) / bb))
                left += along * along * bb - 2 * along * (db - a * (fb - bb))
                value += max(0.0, 1.0 - value) / (1.0 + np.exp(OTHER - 0.5 * left))
            alpha[y, x] = value
            known = max(determinant / m11 - 1 / lean**2, 1e-6)
            contrast[y, x] = np.sqrt(known)
            trust[y, x] = min(FAINT, known)
    return alpha, contrast, trust

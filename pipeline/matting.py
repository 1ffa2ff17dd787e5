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
from pipeline.settings import SegmentationSettings
from rig.mesh_files import linear_from_srgb

INSIDE_PX = 3  # the subject's colour is taken this far inside the first contour: beyond the blur of an edge (3 sigma)
SOLID = 0.85  # alpha above which a pixel shows the subject's own colour, and not hair before the background
WINDOW_PX = 3.0  # sigma of the window it is averaged in
LEAN = 0.5  # standard deviation of alpha at which the coarse mask counts as much as the pixel
LINEAR = (255 * linear_from_srgb(np.arange(257) / 255.0)).astype(np.float32)  # by code, one more to interpolate to
SHADE = (
    0.15  # standard deviation of the subject's brightness at the rim, of full alpha: surfaces darken as they turn away
)
FAR = 0.01  # weight of a window four times as wide, which speaks where the near one holds no pixel


@dataclass(frozen=True, slots=True, eq=False)
class Matte:
    """Alpha (about 0 to 1, smoothed), and how far the subject stands out along its contour."""

    alpha: Float32[np.ndarray, "h w"]
    contrast: Float32[np.ndarray, " c"]  # |F - B| in standard deviations, at every pixel of the contour


def solve_matte(
    image: UInt8[np.ndarray, "h w 3"],
    image_coarse: Float32[np.ndarray, "hc wc 3"],
    background: Background,
    probability: Float32[np.ndarray, "hc wc"],
    settings: SegmentationSettings,
) -> Matte:
    """Alpha of the subject whose coarse probability is given."""
    mask = probability > 0.5
    band = int(np.ceil(settings.band_px * mask.shape[1] / image.shape[1]))
    outside, inside = ~dilated(mask, band), eroded(mask, 3 * band)  # hair is sparse far inside its outline
    light = _light_outside(image_coarse, background, mask)
    sigma = background.noise @ np.full(3, 1 / 3, np.float32)
    subject = spread(image_coarse, eroded(mask, 2), 2.0)
    zone = np.ones(mask.shape, np.uint8)
    zone[outside], zone[inside] = 0, 2
    args = (LINEAR, image, background.expected, light, sigma, zone, probability)
    first, _ = _alpha(*args, subject, LEAN, SHADE)
    first = cv2.GaussianBlur(first, (0, 0), settings.alpha_blur_px)
    second, contrast = _alpha(*args, _subject_inside(image, first, subject), LEAN, SHADE)
    alpha = cv2.GaussianBlur(second, (0, 0), settings.alpha_blur_px)
    return Matte(alpha, contrast[(np.abs(alpha - 0.5) < 0.25) & (contrast >= 0)])


def eroded(mask: Bool[np.ndarray, "h w"], steps: int) -> Bool[np.ndarray, "h w"]:
    """Where the subject is left by a border of ``steps`` pixels; the image's own border is none."""
    return cv2.erode(mask.view(np.uint8), _disc(steps), borderValue=1).view(bool)


def dilated(mask: Bool[np.ndarray, "h w"], steps: int) -> Bool[np.ndarray, "h w"]:
    return cv2.dilate(mask.view(np.uint8), _disc(steps)).view(bool)


def spread(
    values: Float32[np.ndarray, "h w c"], where: Bool[np.ndarray, "h w"], sigma: float
) -> Float32[np.ndarray, "h w c"]:
    """Values carried from ``where`` to every pixel: a mean in a Gaussian window, a wider one where that is empty."""
    weight = where.astype(np.float32)
    stack = np.concatenate([values * weight[:, :, None], weight[:, :, None]], axis=2)
    near = cv2.GaussianBlur(stack, (0, 0), sigma)
    small = (max(4, values.shape[1] // 4), max(4, values.shape[0] // 4))
    far = cv2.GaussianBlur(cv2.resize(stack, small, interpolation=cv2.INTER_AREA), (0, 0), max(sigma, 1.0) * 2)
    near += FAR * cv2.resize(far, (values.shape[1], values.shape[0]), interpolation=cv2.INTER_LINEAR)
    near += 1e-6 * stack.mean((0, 1))
    return near[:, :, :-1] / np.maximum(near[:, :, -1:], 1e-9)


def _disc(steps: int) -> UInt8[np.ndarray, "k k"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * steps + 1, 2 * steps + 1))


def _light_outside(
    image: Float32[np.ndarray, "h w 3"], background: Background, mask: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """What the background just outside shines like, by what was expected of it."""
    clear = ~dilated(mask, 2)
    if not clear.any():
        return np.ones_like(image)
    seen, wanted = (spread(values, clear, 2.5) for values in (image, background.coarse))
    return np.clip(seen / np.maximum(wanted, 4.0), 0.3, 1.5)


def _subject_inside(
    image: UInt8[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"], coarse: Float32[np.ndarray, "hc wc 3"]
) -> Float32[np.ndarray, "h2 w2 3"]:
    """The subject's colour near its contour, at half resolution."""
    half = (image.shape[1] // 2, image.shape[0] // 2)
    inner = eroded(alpha > 0.5, INSIDE_PX) & (alpha > SOLID)
    weight = cv2.resize(inner.view(np.uint8) * np.float32(1), half, interpolation=cv2.INTER_AREA)
    colour = cv2.resize(image, half, interpolation=cv2.INTER_AREA).astype(np.float32)
    sure = (weight > 0.99).astype(np.float32)[:, :, None]
    total = cv2.GaussianBlur(np.concatenate([colour * sure, sure], axis=2), (0, 0), WINDOW_PX / 2)
    total[:, :, :3] += 0.02 * cv2.resize(coarse, half, interpolation=cv2.INTER_LINEAR)
    return total[:, :, :3] / (total[:, :, 3:] + 0.02)


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


@njit(cache=True, nogil=True)
def _alpha(
    table: np.ndarray,
    image: np.ndarray,
    expected: np.ndarray,
    light: np.ndarray,
    sigma: np.ndarray,
    zone: np.ndarray,
    probability: np.ndarray,
    subject: np.ndarray,
    lean: float,
    shade: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Alpha (-0.5 to 1.5) of every pixel, and |F - B| in standard deviations in the band (-1 elsewhere).

    ``zone``: 0 outside, 1 band, 2 inside.
    """
    height, width = image.shape[:2]
    ch, cw = zone.shape
    alpha = np.empty((height, width), np.float32)
    contrast = np.full((height, width), -1.0, np.float32)
    for y in range(height):
        zy = min(y * ch // height, ch - 1)
        ly, fly = _corner(y, height, ch)
        sy, fsy = _corner(y, height, subject.shape[0])
        for x in range(width):
            zx = min(x * cw // width, cw - 1)
            kind = zone[zy, zx]
            if kind != 1:
                alpha[y, x] = 0.0 if kind == 0 else 1.0
                continue
            lx, flx = _corner(x, width, cw)
            sx, fsx = _corner(x, width, subject.shape[1])
            noise = sigma[zy, zx]
            ff, fb, bb, df, db, square = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # sums in standard deviations
            for c in range(3):
                b = expected[y, x, c] * _between(light, ly, lx, c, fly, flx)
                f = _between(subject, sy, sx, c, fsy, fsx)
                code = min(int(0.5 * (f + b)), 255)
                slope = (table[code + 1] - table[code]) * noise
                b, f, i = _decoded(table, b) / slope, _decoded(table, f) / slope, table[image[y, x, c]] / slope
                ff += f * f
                fb += f * b
                bb += b * b
                df += (i - b) * f
                db += (i - b) * b
                square += (f - b) * (f - b)
            p00, p01 = probability[ly, lx], probability[ly, lx + 1]
            p10, p11 = probability[ly + 1, lx], probability[ly + 1, lx + 1]
            prior = (1 - fly) * (p00 + flx * (p01 - p00)) + fly * (p10 + flx * (p11 - p10))
            # Normal equations of I - B = q F - alpha B, with q = alpha (within shade) and alpha = prior (within LEAN).
            m11, m12, m22 = ff + 1 / shade**2, -fb - 1 / shade**2, bb + 1 / shade**2 + 1 / lean**2
            r1, r2 = df, -db + prior / lean**2
            value = (m11 * r2 - m12 * r1) / (m11 * m22 - m12 * m12)
            alpha[y, x] = min(1.5, max(-0.5, value))  # wide, because clipping noise at 0 and 1 would bend the ramp
            contrast[y, x] = np.sqrt(square)
    return alpha, contrast

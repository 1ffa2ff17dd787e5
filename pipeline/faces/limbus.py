"""Finds the limbus, the border between iris and sclera, in the picture of an eye, as sub-pixel edges along rays.

A ray starts at each point of a predicted limbus and points away from the iris. The edge is the strongest step from dark
to bright along the ray. Slopes of neighbouring rays are averaged, since the limbus is smooth and noise is not. Rays
that the lids interrupt get no edge.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from rig.camera import Camera
from rig.colour_space import linear_from_srgb
from rig.image import ImageRgb

BLUR_PX = 0.8  # of pictures before their slope is taken: noise of a pixel is not an edge
STEP_PX = 0.25  # along a ray
FINE = 4  # cells a pixel of the lids' map
CLEAR_PX = -3.0  # inside the lids' edges, which the network has up to three pixels off
BEYOND_PX = (1.2, 2.0)  # where white, and no skin, must show beyond the edge
SKIN_PX = 3.0  # beyond the lids' edges there is skin
MAX_SKIN = 0.55  # half way
MAX_WHITE = 1.5  # brightness, by the white's: what is brighter mirrors a lamp
WHITE = 0.8  # quantile of brightness between the lids
BRIGHT, PALE = 0.6, 0.15  # quantiles: of brightness between the lids, and of the redness of what is brighter
MIN_PIXELS = 20
ALONG_RAYS = 2.0  # deviation of the average over rays: 1.5 px of an iris of 11 px, as the pictures' own blur
MIN_STEP = 0.06  # slope a pixel, by the white's brightness: noise of 1.5 % has 0.01 once blurred
CROP = 2.2  # half side of what is cut out, by the eye's length


@dataclass(frozen=True, slots=True, eq=False)
class EyeView:
    """Holds one camera's crop of an eye: linear brightness (1 for the white of the eye), the similarity of each pixel's
    colour to skin (0 to 1), and the distance inside the lids' edges (px, ``FINE`` cells for each pixel). ``origin_px``
    is the position of the crop's first pixel in the picture."""

    camera: Camera
    origin_px: Float[np.ndarray, " 2"]
    brightness: Float32[np.ndarray, "h w"]
    skin: Float32[np.ndarray, "h w"]
    clear_px: Float32[np.ndarray, "a b"]


def eye_view(camera: Camera, image: ImageRgb, lids_px: Float[np.ndarray, "16 2"]) -> EyeView | None:
    """Cuts an eye out of a picture. ``lids_px`` are the edges of the eye's lids, in the order of ``FaceDetection``.
    Returns None if the eye lies outside the picture."""
    height, width = image.shape[:2]
    half = CROP * 0.5 * float(np.linalg.norm(lids_px[8] - lids_px[0]))
    middle = lids_px.mean(axis=0)
    left, top = np.floor(np.maximum(middle - half, 0.0)).astype(int)
    right, bottom = np.ceil(np.minimum(middle + half, (width - 1, height - 1))).astype(int)
    if right - left < 8 or bottom - top < 8:
        return None
    linear = linear_from_srgb(image[top : bottom + 1, left : right + 1] / 255.0).astype(np.float32)
    crop = cv2.GaussianBlur(linear, (0, 0), BLUR_PX)  # blur is symmetric in light, not in levels
    brightness = 0.5 * (crop[:, :, 0] + crop[:, :, 1])
    outline = np.concatenate([lids_px[:9], lids_px[:8:-1]]) - (left, top)
    inside = np.zeros((crop.shape[0] * FINE, crop.shape[1] * FINE), np.uint8)
    cv2.fillPoly(inside, [np.rint((outline + 0.5) * FINE - 0.5).astype(np.int32)], 1)
    clear = (cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)) / FINE
    fine = inside[FINE // 2 :: FINE, FINE // 2 :: FINE]
    skin = _skin_share(crop, brightness, fine > 0)
    if skin is None:
        return None
    white = max(float(np.quantile(brightness[fine > 0], WHITE)), 1e-3)
    return EyeView(camera, np.array([left, top], float), brightness / white, skin, clear)


def _skin_share(
    crop: Float32[np.ndarray, "h w 3"], brightness: Float32[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"] | None:
    """Returns the similarity of colours to skin: 0 for the palest colour between the lids, 1 for the colours around
    them."""
    redness = (crop[:, :, 0] - crop[:, :, 2]) / (crop.sum(axis=2) + 1e-3)
    far = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=int(SKIN_PX)) == 0
    if inside.sum() < MIN_PIXELS or far.sum() < MIN_PIXELS:
        return None
    bright = inside & (brightness >= np.quantile(brightness[inside], BRIGHT))
    white, skin = np.quantile(redness[bright], PALE), np.median(redness[far])
    return ((redness - white) / max(float(skin - white), 1e-3)).astype(np.float32)


def limbus_offsets(
    view: EyeView, points_px: Float[np.ndarray, "n 2"], outwards: Float[np.ndarray, "n 2"], reach_px: float
) -> Float[np.ndarray, " n"]:
    """Returns the distance (px) from each predicted limbus point to the image edge along the unit direction
    ``outwards``; NaN if there is no edge within ``reach_px``, or if lids cover it. The points surround the iris."""
    count = max(int(np.ceil(reach_px / STEP_PX)), 2)
    along = np.arange(-count - 1, count + 2) * STEP_PX
    at = points_px[:, None] + along[None, :, None] * outwards[:, None] - view.origin_px
    profile = _sampled(view.brightness, at)
    slope = (profile[:, 2:] - profile[:, :-2]) / (2.0 * STEP_PX)
    clear = _sampled(view.clear_px, (at[:, 1:-1] + 0.5) * FINE - 0.5)
    near, far = (at[:, 1:-1] + px * outwards[:, None] for px in BEYOND_PX)
    skin = np.maximum(_sampled(view.skin, near), _sampled(view.skin, far))
    glare = np.maximum(_sampled(view.brightness, near), _sampled(view.brightness, far))
    slope = _averaged_along(slope, (clear > CLEAR_PX) & (skin < MAX_SKIN) & (glare < MAX_WHITE))
    best = np.clip(slope.argmax(axis=1), 1, slope.shape[1] - 2)
    rows = np.arange(len(best))
    before, peak, after = (slope[rows, best + step] for step in (-1, 0, 1))
    found = (peak >= MIN_STEP) & (peak >= before) & (peak >= after) & (before > 0.0) & (after > 0.0)
    bend = np.where(found, before - 2.0 * peak + after, -1.0)
    shift = 0.5 * (before - after) / np.minimum(bend, -1e-9)
    return np.where(found, along[1:-1][best] + shift * STEP_PX, np.nan)


def _averaged_along(slope: Float[np.ndarray, "n k"], valid: Bool[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Returns the brightness slope averaged over neighbouring valid rays; 0 where the ray itself is not valid."""
    apart = np.abs(np.arange(len(slope)) - np.arange(len(slope))[:, None])
    near = np.minimum(apart, len(slope) - apart)  # the rays go round
    share = np.where(near <= 3 * ALONG_RAYS, np.exp(-0.5 * (near / ALONG_RAYS) ** 2), 0.0)
    total, weight = share @ np.where(valid, slope, 0.0), share @ valid.astype(float)
    return np.where(valid, total / np.maximum(weight, 1e-9), 0.0)


def _sampled(values: Float32[np.ndarray, "h w"], at: Float[np.ndarray, "n k 2"]) -> Float[np.ndarray, "n k"]:
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)

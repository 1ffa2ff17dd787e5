"""Which point of a surface which camera sees, how well, and in what colour: the work of section 4.5, compiled.

The paper asks for a projection inside the silhouette and no occlusion. Real edges are blurred and fits are not exact,
so a margin is kept: to the contour (no background reaches the mesh), and to occluding edges of the head itself (no nose
on the cheek behind it), where the nearest surface in a small window counts, less what the surface's own slope explains.
A view beside an occluding edge, or at a flat angle, speaks only where there is no better one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numba import njit

from pipeline.regions import box_around
from pipeline.settings import TextureSettings
from pipeline.silhouette import Silhouette
from pipeline.zbuffer import camera_depths
from rig.camera import Camera
from rig.mesh_files import linear_from_srgb

LINEAR = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
WINDOW = 2  # pixels around a vertex in which a nearer surface may blur over it: 3 sigma of the preset's defocus
SLOPE_SLACK = 1.5  # by how much more than its own slope a surface may come nearer within the window
UNSHARP_PX = 1.0  # sigma; 1.5 is 0.6 dB worse on a head of another renderer
POWER_PX = 2.0  # sigma of the window in which detail is told from noise
NOISE_MARGIN = 2.0  # by which the median power is multiplied: its own scatter in that window is a third
POOR = 1e-4  # weight of a view that has nothing but excuses, by that of a good one


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """One camera's view of every point: weight (0 = not seen) and linear colour (0 to 1)."""

    weights: Float32[np.ndarray, " v"]
    colours: Float32[np.ndarray, "v 3"]


def see_points(
    camera: Camera,
    image: UInt8[np.ndarray, "h w 3"],
    silhouette: Silhouette,
    depth: Float32[np.ndarray, "h w"],
    points: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    settings: TextureSettings,
) -> Sight:
    """What ``camera`` gives each point of a surface, world frame, of which it has the depth map ``depth``."""
    pixels, depths = camera.project(points), camera_depths(camera, points)
    towards = camera.centre_world - points
    facing = np.einsum("vi,vi->v", normals, towards) / np.sqrt(np.einsum("vi,vi->v", towards, towards))
    weights = _weights(
        pixels,
        depths,
        facing,
        depth,
        silhouette.distance,
        1.0 / camera.intrinsics.fx,
        (settings.contour_margin_px, settings.hidden_mm, settings.least_facing, settings.sharpness),
    )
    return Sight(weights, _samples(image, pixels, weights, LINEAR, settings.footprint_px))


def sharpened(
    image: UInt8[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"], settings: TextureSettings
) -> UInt8[np.ndarray, "h w 3"]:
    """The photograph with some of the lens's blur, and of the sampling window's, taken back where there is detail.

    An unsharp mask would lift noise with it, so that it is held back as a Wiener filter does: by the share of what it
    would lift, over some pixels, that is more than noise. Most of a head is smooth: the median over it is noise.
    """
    box = box_around(inside, 0)
    if not settings.sharpening or not inside[box].size:
        return image
    own = image[box].astype(np.float32)
    detail = own - cv2.GaussianBlur(own, (0, 0), UNSHARP_PX)
    power = cv2.GaussianBlur((detail * detail) @ np.full(3, 1 / 3, np.float32), (0, 0), POWER_PX)
    noise = NOISE_MARGIN * float(np.median(power[::4, ::4][inside[box][::4, ::4]]))
    gain = settings.sharpening * np.clip(1 - noise / np.maximum(power, 1e-3), 0, 1)
    out = image.copy()
    out[box] = np.clip(own + gain[:, :, None] * detail + 0.5, 0, 255)
    return out


@njit(cache=True, nogil=True, inline="always")
def _nearest(depth: np.ndarray, row: int, column: int, reach: int) -> float:
    nearest = np.inf
    for j in range(max(0, row - reach), min(depth.shape[0], row + reach + 1)):
        for i in range(max(0, column - reach), min(depth.shape[1], column + reach + 1)):
            nearest = min(nearest, depth[j, i])
    return nearest


@njit(cache=True, nogil=True)
def _weights(
    pixels: np.ndarray,
    depths: np.ndarray,
    facing: np.ndarray,
    depth: np.ndarray,
    distance: np.ndarray,
    pixel_angle: float,
    limits: tuple[float, float, float, float],
) -> np.ndarray:
    margin, hidden, least, sharpness = limits
    height, width = depth.shape
    weights = np.zeros(len(depths), np.float32)
    for v in range(len(depths)):
        x, y, cosine = pixels[v, 0], pixels[v, 1], facing[v]
        if not (x >= 1 and y >= 1 and x < width - 2 and y < height - 2 and cosine > 0.02):  # NaN is not seen either
            continue
        column, row = int(x + 0.5), int(y + 0.5)
        clear = -distance[row, column] - margin
        if clear <= 0:
            continue
        slope = np.sqrt(1 - min(1.0, cosine * cosine)) / cosine
        step = pixel_angle * depths[v] * min(slope, 4.0)  # how much nearer its own surface comes within a pixel
        # Its own pixel shows it at the pixel's centre; the next ones are in its sample.
        if depths[v] > depth[row, column] + hidden + 0.5 * step:
            continue
        if depths[v] > _nearest(depth, row, column, 1) + hidden + SLOPE_SLACK * 2.1 * step:
            continue
        around = _nearest(depth, row, column, WINDOW)
        good = cosine > least and depths[v] <= around + hidden + SLOPE_SLACK * 1.414 * WINDOW * step
        # A ramp from the margin inwards, so that a camera's share begins at nothing and leaves no seam.
        ramp = min(1.0, clear / (2 * margin + 1.0))
        weights[v] = (1.0 if good else POOR) * cosine**sharpness * ramp / (depths[v] * depths[v]) * 1e6
    return weights


@njit(cache=True, nogil=True)
def _samples(image: np.ndarray, pixels: np.ndarray, weights: np.ndarray, table: np.ndarray, sigma: float) -> np.ndarray:
    """Linear colours in a Gaussian window of 4 x 4 pixels around each projection: less noise than one sample has.

    The window averages codes: its noise is even there, and a dark crease does not drown in the light beside it.
    """
    height, width = image.shape[:2]
    out = np.zeros((len(weights), 3), np.float32)
    scale = -0.5 / (sigma * sigma)
    for v in range(len(weights)):
        if weights[v] <= 0:
            continue
        x, y = pixels[v, 0], pixels[v, 1]
        left, top = int(np.floor(x)) - 1, int(np.floor(y)) - 1
        total, r, g, b = 0.0, 0.0, 0.0, 0.0
        for j in range(max(0, top), min(height, top + 4)):
            for i in range(max(0, left), min(width, left + 4)):
                share = np.exp(scale * ((i - x) * (i - x) + (j - y) * (j - y)))
                total += share
                r += share * image[j, i, 0]
                g += share * image[j, i, 1]
                b += share * image[j, i, 2]
        for c, code in enumerate((r / total, g / total, b / total)):
            low = min(int(code), 254)
            out[v, c] = table[low] + (code - low) * (table[low + 1] - table[low])
    return out

"""Compiled loops of ``pipeline.texturing.visibility``."""

import numpy as np

from rig.jit import njit

WINDOW = 2  # pixels around a vertex in which a nearer surface may blur over it: 3 sigma of the preset's defocus
SLOPE_SLACK = 1.5  # by how much more than its own slope a surface may come nearer within the window
POOR = 1e-4  # weight of a view that has nothing but excuses, by that of a good one


@njit(cache=True, nogil=True, inline="always")
def nearest_sample(depth: np.ndarray, row: int, column: int, reach: int) -> float:
    """Returns the smallest depth (mm) within ``reach`` pixels of a pixel, across and down."""
    nearest = np.inf
    for j in range(max(0, row - reach), min(depth.shape[0], row + reach + 1)):
        for i in range(max(0, column - reach), min(depth.shape[1], column + reach + 1)):
            nearest = min(nearest, depth[j, i])
    return nearest


@njit(cache=True, nogil=True)
def visibility_weights(
    pixels: np.ndarray,
    depths: np.ndarray,
    facing: np.ndarray,
    depth: np.ndarray,
    distance: np.ndarray,
    pixel_angle: float,
    limits: tuple[float, float, float, float],
) -> np.ndarray:
    """Returns how well one camera sees each point (v), float32; 0 where it does not.

    A point counts if it lies inside the silhouette by a margin, and no nearer surface of the depth map hides it. Its
    weight is cosine^sharpness / depth^2, reduced towards the margin, and ``POOR`` times that at a flat angle or beside
    an occluding edge.

    Args:
        pixels: of the points (v, 2).
        depths: of the points along the camera's z axis, mm.
        facing: cosine between normal and line of sight.
        depth: the surface's depth map, mm.
        distance: signed distance to the silhouette, px.
        pixel_angle: width of a pixel at a depth of 1.
        limits: margin to the silhouette (px), depth by which a nearer surface hides a point (mm), smallest cosine of a
            good view, and the exponent of the cosine.
    """
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
        if depths[v] > nearest_sample(depth, row, column, 1) + hidden + SLOPE_SLACK * 2.1 * step:
            continue
        around = nearest_sample(depth, row, column, WINDOW)
        good = cosine > least and depths[v] <= around + hidden + SLOPE_SLACK * 1.414 * WINDOW * step
        # A ramp from the margin inwards, so that a camera's share begins at nothing and leaves no seam.
        ramp = min(1.0, clear / (2 * margin + 1.0))
        weights[v] = (1.0 if good else POOR) * cosine**sharpness * ramp / (depths[v] * depths[v]) * 1e6
    return weights


@njit(cache=True, nogil=True)
def sample_colours(
    image: np.ndarray, pixels: np.ndarray, weights: np.ndarray, table: np.ndarray, sigma: float
) -> np.ndarray:
    """Returns the linear colours (v, 3) of the points with a weight, from a Gaussian window of 4 x 4 pixels around each
    projection, which has less noise than a single sample.

    The window averages sRGB codes, in which noise is even and a dark crease is not outshone by the light beside it.
    ``table`` is the linear light of each code, ``sigma`` the window's width in px.
    """
    height, width = image.shape[:2]
    out, across, down = np.zeros((len(weights), 3), np.float32), np.empty(4), np.empty(4)
    scale = -0.5 / (sigma * sigma)
    for v in range(len(weights)):
        if weights[v] <= 0:
            continue
        x, y = pixels[v, 0], pixels[v, 1]
        left, top = int(np.floor(x)) - 1, int(np.floor(y)) - 1
        total, r, g, b = 0.0, 0.0, 0.0, 0.0
        for k in range(4):
            across[k], down[k] = np.exp(scale * (left + k - x) ** 2), np.exp(scale * (top + k - y) ** 2)
        for j in range(max(0, top), min(height, top + 4)):
            for i in range(max(0, left), min(width, left + 4)):
                share = across[i - left] * down[j - top]
                total += share
                r += share * image[j, i, 0]
                g += share * image[j, i, 1]
                b += share * image[j, i, 2]
        for c, code in enumerate((r / total, g / total, b / total)):
            low = min(int(code), 254)
            out[v, c] = table[low] + (code - low) * (table[low + 1] - table[low])
    return out

"""Signed distance to a sub-pixel contour: the level set of a smooth field on the pixel grid.

The contour is what marching squares draws between pixel centres. Up to ``BAND_PX`` from it every pixel takes the
nearest contour piece that its neighbours know (two passes of vector propagation: Danielsson, *Euclidean distance
mapping*, 1980), which is exact but for few pixels, wrong by less than 0.1 px. Farther out nobody needs hundredths of a
pixel: there it is a 5 x 5 chamfer transform of the mask, good to half a pixel and 2 %, blended in over the band's outer
half.
"""

import cv2
import numpy as np
from jaxtyping import Float32
from numba import njit

BAND_PX = 16.0


def distance_to_level(field: Float32[np.ndarray, "h w"], level: float = 0.5) -> Float32[np.ndarray, "h w"]:
    """Signed distance (px) to the contour ``field == level``; negative where the field is above. +-inf without one."""
    segments = _segments(field, level)
    if not len(segments):
        return np.where(field > level, -np.inf, np.inf).astype(np.float32)
    above = (field > level).view(np.uint8)
    inside = cv2.distanceTransform(above, cv2.DIST_L2, cv2.DIST_MASK_5)
    whole = cv2.distanceTransform(1 - above, cv2.DIST_L2, cv2.DIST_MASK_5)
    _join(whole, inside)
    _refine(whole, field, level, segments, BAND_PX)
    return whole


@njit(cache=True, nogil=True)
def _segments(field: np.ndarray, level: float) -> np.ndarray:
    """Marching squares: rows (x0, y0, x1, y1, x cell, y cell). Ambiguous cells are split by their mean."""
    height, width = field.shape
    out = np.empty((height * width // 4 + 16, 6), np.float32)
    count = 0
    xs, ys = np.empty(4, np.float32), np.empty(4, np.float32)
    for y in range(height - 1):
        for x in range(width - 1):
            a, b = field[y, x] - level, field[y, x + 1] - level
            c, d = field[y + 1, x + 1] - level, field[y + 1, x] - level
            above = (a > 0) + (b > 0) + (c > 0) + (d > 0)
            if above == 0 or above == 4:
                continue
            n = 0
            if (a > 0) != (b > 0):
                xs[n], ys[n] = x + a / (a - b), y
                n += 1
            if (b > 0) != (c > 0):
                xs[n], ys[n] = x + 1, y + b / (b - c)
                n += 1
            if (c > 0) != (d > 0):
                xs[n], ys[n] = x + d / (d - c), y + 1
                n += 1
            if (d > 0) != (a > 0):
                xs[n], ys[n] = x, y + a / (a - d)
                n += 1
            if count + 2 > out.shape[0]:
                return out[:count]
            if n == 2:
                out[count, 0], out[count, 1], out[count, 2], out[count, 3] = xs[0], ys[0], xs[1], ys[1]
                out[count, 4], out[count, 5] = x, y
                count += 1
                continue
            # Four crossings, in the order top, right, bottom, left: the mean says which corners belong together.
            joined = (a + b + c + d > 0) == (a > 0)
            for k in range(2):
                p, q = (2 * k, 2 * k + 1) if joined else ((2 * k + 3) % 4, 2 * k)
                out[count, 0], out[count, 1], out[count, 2], out[count, 3] = xs[p], ys[p], xs[q], ys[q]
                out[count, 4], out[count, 5] = x, y
                count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def _join(outside: np.ndarray, inside: np.ndarray) -> None:
    """Signed distance in place of ``outside``; a transform ends at pixel centres, half a pixel beyond the contour."""
    for y in range(outside.shape[0]):
        for x in range(outside.shape[1]):
            outside[y, x] = 0.5 - inside[y, x] if inside[y, x] > 0 else outside[y, x] - 0.5


@njit(cache=True, nogil=True, inline="always")
def _square_to_segment(x: float, y: float, segments: np.ndarray, k: int) -> float:
    ax, ay = segments[k, 0], segments[k, 1]
    ex, ey = segments[k, 2] - ax, segments[k, 3] - ay
    length = ex * ex + ey * ey
    t = 0.0
    if length > 0:
        t = min(1.0, max(0.0, ((x - ax) * ex + (y - ay) * ey) / length))
    dx, dy = x - ax - t * ex, y - ay - t * ey
    return dx * dx + dy * dy


@njit(cache=True, nogil=True)
def _refine(whole: np.ndarray, field: np.ndarray, level: float, segments: np.ndarray, band: float) -> None:
    """Replaces the distances of the band in place."""
    height, width = field.shape
    near = np.full((height, width), -1, np.int32)
    best = np.full((height, width), np.float32(1e12), np.float32)
    for k in range(len(segments)):
        x0, y0 = int(segments[k, 4]), int(segments[k, 5])
        for y in range(max(0, y0 - 1), min(height, y0 + 3)):
            for x in range(max(0, x0 - 1), min(width, x0 + 3)):
                square = _square_to_segment(x, y, segments, k)
                if square < best[y, x]:
                    best[y, x], near[y, x] = square, k
    for step in range(2):
        back = -1 if step == 0 else 1
        for row in range(height):
            y = row if step == 0 else height - 1 - row
            if 0 <= y + back < height:
                for x in range(width):
                    if abs(whole[y, x]) < band:
                        for dx in range(-1, 2):
                            _take(near, best, segments, x, y, x + dx, y + back)
            for x in range(width):
                if abs(whole[y, x]) < band:
                    _take(near, best, segments, x, y, x - 1, y)
            for x in range(width - 1, -1, -1):
                if abs(whole[y, x]) < band:
                    _take(near, best, segments, x, y, x + 1, y)
    for y in range(height):
        for x in range(width):
            if near[y, x] >= 0:
                exact = np.sqrt(best[y, x]) * (-1.0 if field[y, x] > level else 1.0)
                share = min(1.0, max(0.0, 2.0 - 2.0 * abs(exact) / band))
                whole[y, x] += share * (exact - whole[y, x])


@njit(cache=True, nogil=True, inline="always")
def _take(near: np.ndarray, best: np.ndarray, segments: np.ndarray, x: int, y: int, from_x: int, from_y: int) -> None:
    """Pixel (x, y) takes its neighbour's contour piece if that is nearer."""
    if 0 <= from_x < near.shape[1]:
        k = near[from_y, from_x]
        if k >= 0 and k != near[y, x]:
            square = _square_to_segment(x, y, segments, k)
            if square < best[y, x]:
                best[y, x], near[y, x] = square, k

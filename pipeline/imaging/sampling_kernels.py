"""Holds bilinear interpolation for compiled loops, and the distance to a contour. The helper functions are inlined, so
they use the floating-point mode (fast or strict) of the calling loop.

Four neighbouring pixels are named ``a b`` (upper row) and ``c d`` (lower row); ``right`` and ``down`` (0 to 1) are the
offsets of a point from ``a``."""

import numpy as np

from rig.jit import njit

INSIDE = 1.001  # px before an image's far edge where places beyond are held: all four neighbours are then inside


@njit(cache=True, nogil=True, inline="always")
def bilinear(a, b, c, d, right, down):
    """Returns the bilinear value between four neighbouring pixels."""
    top = a + right * (b - a)
    return top + down * (c + right * (d - c) - top)


@njit(cache=True, nogil=True, inline="always")
def bilinear_slopes(a, b, c, d, right, down):
    """Returns the derivatives of ``bilinear`` by ``right`` and by ``down``."""
    return b - a + down * ((d - c) - (b - a)), c + right * (d - c) - (a + right * (b - a))


@njit(cache=True, nogil=True, inline="always")
def held(at, size):
    """Returns a coordinate clamped to an image that has ``size`` pixels along this axis."""
    return min(max(at, 0.0), size - INSIDE)


@njit(cache=True, nogil=True, inline="always")
def cell(at, size):
    """Returns the pixel before a coordinate along one axis, and the fraction of the way to the next pixel. Outside the
    image, this fraction is below 0 or above 1, so that the outermost two pixels are extrapolated."""
    low = min(max(int(np.floor(at)), 0), size - 2)
    return low, at - low


@njit(cache=True, nogil=True, inline="always")
def sample(image, column, row):
    """Returns the bilinear value of an image (h, w) at a point inside it."""
    i, j = int(row), int(column)
    return bilinear(image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1], column - j, row - i)


@njit(cache=True, nogil=True, inline="always")
def sample_row(images, at, width, right, down):
    """Returns the bilinear value of an image that is stored row by row in the flat array ``images``. ``at`` is the
    index of the upper left neighbour pixel, ``width`` the image's width."""
    return bilinear(images[at], images[at + 1], images[at + width], images[at + width + 1], right, down)


@njit(cache=True, nogil=True)
def segments_of_level(field: np.ndarray, level: float) -> np.ndarray:
    """Finds the contour of ``field`` (h, w) at ``level`` by marching squares. Returns the contour's segments as rows
    (x0, y0, x1, y1, x cell, y cell), px. Where the corner values of a cell allow two contours, the mean of all four
    values decides."""
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


@njit(cache=True, nogil=True, fastmath=True)
def refine_distance(whole: np.ndarray, field: np.ndarray, level: float, segments: np.ndarray, band: int) -> None:
    """Replaces the signed distances ``whole`` (h, w; px) near the contour, in place, by exact distances to the
    contour's ``segments``. The exact distance has full weight up to two thirds of ``band`` (px), and weight 0 at its
    end. The sign is negative where ``field`` is above ``level``."""
    height, width = field.shape
    best = np.full((height, width), np.float32(1e12), np.float32)
    for k in range(len(segments)):
        ax, ay = segments[k, 0], segments[k, 1]
        ex, ey = segments[k, 2] - ax, segments[k, 3] - ay
        scale = np.float32(1.0) / max(ex * ex + ey * ey, np.float32(1e-12))
        x0, y0 = int(segments[k, 4]), int(segments[k, 5])
        first, last = max(0, x0 - band + 1), min(width, x0 + band + 1)
        for y in range(max(0, y0 - band + 1), min(height, y0 + band + 1)):
            row, dy = best[y], np.float32(y) - ay
            for x in range(first, last):
                dx = np.float32(x) - ax
                t = min(np.float32(1.0), max(np.float32(0.0), (dx * ex + dy * ey) * scale))
                u, v = dx - t * ex, dy - t * ey
                row[x] = min(row[x], u * u + v * v)
    for y in range(height):
        for x in range(width):
            if best[y, x] < band * band:
                exact = np.sqrt(best[y, x]) * (-1.0 if field[y, x] > level else 1.0)
                share = min(1.0, max(0.0, 3.0 - 3.0 * abs(exact) / band))
                whole[y, x] += share * (exact - whole[y, x])

"""Bilinear interpolation for compiled loops. The helpers are inlined, so that their arithmetic is the calling loop's,
fast or strict.

Four neighbouring pixels are named ``a b`` above ``c d``; ``right`` and ``down`` (0 to 1) say how far a point is from
``a``.
"""

import numpy as np

from rig.jit import njit

INSIDE = 1.001  # px before an image's far edge where places beyond are held: all four neighbours are then inside


@njit(cache=True, nogil=True, inline="always")
def bilinear(a, b, c, d, right, down):
    """Returns the value between four neighbouring pixels."""
    top = a + right * (b - a)
    return top + down * (c + right * (d - c) - top)


@njit(cache=True, nogil=True, inline="always")
def bilinear_slopes(a, b, c, d, right, down):
    """Returns the derivatives of ``bilinear`` by ``right`` and by ``down``."""
    return b - a + down * ((d - c) - (b - a)), c + right * (d - c) - (a + right * (b - a))


@njit(cache=True, nogil=True, inline="always")
def held(at, size):
    """Returns a coordinate along one side of an image, limited to its inside (``size`` pixels)."""
    return min(max(at, 0.0), size - INSIDE)


@njit(cache=True, nogil=True, inline="always")
def cell(at, size):
    """Returns the pixel before a coordinate along one side, and the fraction of the way to the next one. Beyond the
    image the outermost two pixels are extrapolated: the fraction is then below 0 or above 1."""
    low = min(max(int(np.floor(at)), 0), size - 2)
    return low, at - low


@njit(cache=True, nogil=True, inline="always")
def sample(image, column, row):
    """Returns the value of an image (h, w) at a point inside it."""
    i, j = int(row), int(column)
    return bilinear(image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1], column - j, row - i)


@njit(cache=True, nogil=True, inline="always")
def sample_row(images, at, width, right, down):
    """Returns the same value from an image stored row by row in the flat array ``images``. ``at`` is the index of the
    upper left neighbour, ``width`` the image's width."""
    return bilinear(images[at], images[at + 1], images[at + width], images[at + width + 1], right, down)

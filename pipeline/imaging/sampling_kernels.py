"""Bilinear reading for compiled loops. The helpers are inlined: arithmetic is the calling loop's, fast or strict.

Four neighbours are named ``a b`` above ``c d``; ``right`` and ``down`` are the shares, 0 to 1, of the way from ``a``.
"""

import numpy as np

from pipeline.compute.jit import njit

INSIDE = 1.001  # px before an image's far edge where places beyond are held: all four neighbours are then inside


@njit(cache=True, nogil=True, inline="always")
def bilinear(a, b, c, d, right, down):
    """Between four neighbours (top left, top right, bottom left, bottom right), 0 to 1 to the right and down."""
    top = a + right * (b - a)
    return top + down * (c + right * (d - c) - top)


@njit(cache=True, nogil=True, inline="always")
def bilinear_slopes(a, b, c, d, right, down):
    """Derivatives of ``bilinear`` by ``right`` and by ``down``."""
    return b - a + down * ((d - c) - (b - a)), c + right * (d - c) - (a + right * (b - a))


@njit(cache=True, nogil=True, inline="always")
def held(at, size):
    """The place along one side of an image, or the last one inside it."""
    return min(max(at, 0.0), size - INSIDE)


@njit(cache=True, nogil=True, inline="always")
def cell(at, size):
    """The pixel before a place along one side, and the share of the way to the next; the outermost two go on linearly
    beyond the image."""
    low = min(max(int(np.floor(at)), 0), size - 2)
    return low, at - low


@njit(cache=True, nogil=True, inline="always")
def sample(image, column, row):
    """An image's value at a place inside it."""
    i, j = int(row), int(column)
    return bilinear(image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1], column - j, row - i)


@njit(cache=True, nogil=True, inline="always")
def sample_row(images, at, width, right, down):
    """The same of an image that lies row by row in ``images``; ``at``: where its upper left neighbour does."""
    return bilinear(images[at], images[at + 1], images[at + width], images[at + width + 1], right, down)

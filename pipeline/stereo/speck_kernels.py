"""Compiled loops that find and replace specks in a field: pieces of surface too small to be more than chance matches.

Where skin has no texture, any depth along a ray is as good as another, and overlapping windows make the same error.
They form pieces of a few windows' size, before or behind everything around them. Unlike a single wrong pixel, such a
piece is consistent in itself, so that neither planes of neighbours nor a mean over neighbours removes it.
"""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy")
def mark_specks(depth, slopes, gap_mm, most_px, specks):
    """Sets ``specks`` (h, w) at the pixels of every piece of surface that has at most ``most_px`` pixels.

    Neighbouring pixels belong to one piece if their planes, extended half way to each other, are less than ``gap_mm``
    apart.
    """
    height, width = depth.shape
    done, queue = np.zeros((height, width), np.bool_), np.empty(height * width, np.int64)
    specks[:] = False
    for row in range(height):
        for column in range(width):
            if done[row, column] or depth[row, column] <= 0.0:
                continue
            done[row, column] = True
            queue[0], first, last = row * width + column, 0, 1
            while first < last:
                r, c = queue[first] // width, queue[first] % width
                first += 1
                for side in range(4):
                    i, j = (1, -1, 0, 0)[side], (0, 0, 1, -1)[side]
                    if not _in_surface(depth, r + j, c + i) or done[r + j, c + i]:
                        continue
                    here = depth[r, c] + 0.5 * (i * slopes[r, c, 0] + j * slopes[r, c, 1])
                    there = depth[r + j, c + i] - 0.5 * (i * slopes[r + j, c + i, 0] + j * slopes[r + j, c + i, 1])
                    if abs(here - there) < gap_mm:
                        done[r + j, c + i] = True
                        queue[last] = (r + j) * width + c + i
                        last += 1
            if last <= most_px:
                for k in range(last):
                    specks[queue[k] // width, queue[k] % width] = True


@njit(cache=True, nogil=True, error_model="numpy")
def fill_specks(depth, slopes, specks, sweeps):
    """Replaces depth and slopes at the pixels of ``specks``, in place, by the smoothest surface through what surrounds
    them (least squares of the steps between neighbours), in ``sweeps`` of Gauss-Seidel. Specks that touch nothing else
    stay."""
    height, width = depth.shape
    left = specks.copy()
    filled, count, ring = np.empty(height * width, np.int64), 0, -1
    while ring != count:  # ring by ring, from what is about them
        ring = count
        for row in range(height):
            for column in range(width):
                if not left[row, column]:
                    continue
                total, sides = _sum_beside(depth, row, column, left)
                if sides > 0:
                    depth[row, column] = total / sides
                    filled[count] = row * width + column
                    count += 1
        for k in range(ring, count):
            left[filled[k] // width, filled[k] % width] = False
    for _ in range(sweeps):
        for k in range(count):
            row, column = filled[k] // width, filled[k] % width
            total, sides = _sum_beside(depth, row, column, left)
            depth[row, column] = total / sides
    for k in range(count):
        row, column = filled[k] // width, filled[k] % width
        for axis in range(2):
            j, i = axis, 1 - axis
            after, before = _in_surface(depth, row + j, column + i), _in_surface(depth, row - j, column - i)
            high = depth[row + j, column + i] if after else depth[row, column]
            low = depth[row - j, column - i] if before else depth[row, column]
            slopes[row, column, axis] = (high - low) / max(after + before, 1)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _in_surface(depth, row, column):
    height, width = depth.shape
    return 0 <= row < height and 0 <= column < width and depth[row, column] > 0.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sum_beside(depth, row, column, left):
    """Sum of the depths of the four neighbours that are not ``left``, and how many those are."""
    total, sides = 0.0, 0
    for side in range(4):
        j, i = row + (0, 0, 1, -1)[side], column + (1, -1, 0, 0)[side]
        if _in_surface(depth, j, i) and not left[j, i]:
            total += depth[j, i]
            sides += 1
    return total, sides

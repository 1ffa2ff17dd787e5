"""Compiled loop that checks whether the surface of one view lies where the other views have it."""

import numpy as np

from pipeline.geometry.projection_kernels import NEAREST_MM
from pipeline.stereo.matching_kernels import HEIGHT, START, WIDTH
from rig.jit import njit

FAR_TOLERANCES = np.float32(20.0)  # along a ray: at the steepest slope the planes are then six tolerances apart


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, overlaps=False)
def count_agreeing(start, ways, lenses, deviation, depth, slopes, limits, agreeing, before, apart):
    """Fills, for every pixel (h, w) of one view: how many other views have the surface at the same point
    (``agreeing``), how many see through it (``before``: the point lies in front of their surface), and the mean squared
    distance to those that agree (``apart``, mm^2).

    Two views agree if the distance from the other's plane is below ``tolerance_mm``, and below ``deviations`` standard
    deviations of both (or half of ``tolerance_mm``, if that is more). A view in which something nearer hides the point
    does not count. ``limits`` are ``tolerance_mm`` and ``deviations``. ``depth``, ``slopes`` and ``deviation`` hold all
    views one after the other, this view from ``start`` on; ``ways`` are rows of ``Stack.homographies``, ``lenses`` fx
    and fy of the others.
    """
    tolerance_mm, deviations = np.float32(limits[0]), np.float32(limits[1])
    far_mm, zero, half, one = tolerance_mm * FAR_TOLERANCES, np.float32(0.0), np.float32(0.5), np.float32(1.0)
    height, width = agreeing.shape
    live, count, total = np.empty(width, np.int32), np.empty((2, width), np.int32), np.empty(width, np.float32)
    for row in range(height):
        first, lives = np.uint64(start + row * width), 0
        for column in range(width):
            agreeing[row, column], before[row, column], apart[row, column] = 0, 0, zero
            if depth[first + np.uint64(column)] > zero:
                live[lives] = column
                count[0, lives], count[1, lives], total[lives] = 0, 0, zero
                lives += 1
        for k in range(len(ways)):
            way = ways[k]
            r0, r1, r2 = way[1] * row + way[2], way[4] * row + way[5], way[7] * row + way[8]
            there_first, stride = np.uint64(np.int64(way[START])), np.int32(way[WIDTH])
            fx, fy = np.float32(lenses[k, 0]), np.float32(lenses[k, 1])
            for m in range(lives):  # without branches, so that it is vectorised
                column = live[m]
                p = first + np.uint64(np.uint32(column))
                z, mine = depth[p], deviation[p]
                there = z * (way[6] * column + r2) + way[11]
                per = 1.0 / max(there, NEAREST_MM)
                x, y = (z * (way[0] * column + r0) + way[9]) * per, (z * (way[3] * column + r1) + way[10]) * per
                inside = (there >= NEAREST_MM) & (x >= 0.0) & (y >= 0.0)
                inside = inside & (x <= way[WIDTH] - 1.0) & (y <= way[HEIGHT] - 1.0)
                u, v = np.float32(x if inside else 0.0), np.float32(y if inside else 0.0)
                i, j = np.int32(u + half), np.int32(v + half)
                q = there_first + np.uint64(np.uint32(j * stride + i))
                shown, z_x, z_y = depth[q], slopes[q, 0], slopes[q, 1]
                behind = np.float32(there) - shown
                off = behind - (u - np.float32(i)) * z_x - (v - np.float32(j)) * z_y
                by = one / max(shown, one)
                a, b = z_x * fx * by, z_y * fy * by
                upright = one / np.sqrt(one + a * a + b * b)  # cosine between the other's ray and its plane's normal
                distance, theirs = off * upright, deviation[q] * upright
                limit = min(max(deviations * np.sqrt(mine * mine + theirs * theirs), half * tolerance_mm), tolerance_mm)
                known = inside & (shown > zero) & (behind <= far_mm)
                same = known & (abs(distance) < limit) & (behind >= -far_mm)
                past = known & (not same) & ((distance < zero) | (behind < -far_mm))
                count[0, m] += same
                count[1, m] += past
                total[m] += distance * distance if same else zero
        for m in range(lives):
            column = live[m]
            agreeing[row, column], before[row, column] = count[0, m], count[1, m]
            apart[row, column] = total[m] / max(np.float32(count[0, m]), one)

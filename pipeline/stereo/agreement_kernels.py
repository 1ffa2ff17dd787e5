"""Compiled loop that checks whether the surface of one view lies where the other views have it."""

import numpy as np

from pipeline.geometry.projection_kernels import NEAREST_MM, placed
from pipeline.stereo.matching_kernels import HEIGHT, START, WIDTH
from rig.jit import njit

FAR_TOLERANCES = 20.0  # along a ray: at the steepest slope the planes are then six tolerances apart


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
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
    tolerance_mm, deviations = limits
    far_mm = FAR_TOLERANCES * tolerance_mm
    height, width = agreeing.shape
    for row in range(height):
        for column in range(width):
            p = row * width + column
            agreeing[row, column] = 0
            before[row, column] = 0
            apart[row, column] = 0.0
            z = depth[start + p]
            if z <= 0.0:
                continue
            total = 0.0
            for k in range(len(ways)):
                way = ways[k]
                x, y, there = placed(way, z * column, z * row, z)
                if there < NEAREST_MM:
                    continue
                x, y = x / there, y / there
                if x < 0.0 or y < 0.0 or x > way[WIDTH] - 1.0 or y > way[HEIGHT] - 1.0:
                    continue
                i, j = int(x + 0.5), int(y + 0.5)
                q = int(way[START]) + j * int(way[WIDTH]) + i
                if depth[q] <= 0.0:
                    continue
                if there > depth[q] + far_mm:
                    continue
                if there < depth[q] - far_mm:
                    before[row, column] += 1
                    continue
                z_x, z_y = slopes[q, 0], slopes[q, 1]
                off = there - (depth[q] + (x - i) * z_x + (y - j) * z_y)
                u, v = z_x * lenses[k, 0] / depth[q], z_y * lenses[k, 1] / depth[q]
                upright = 1.0 / np.sqrt(1.0 + u * u + v * v)  # cosine between the other's ray and its plane's normal
                distance = off * upright
                mine, theirs = deviation[start + p], deviation[q] * upright
                limit = min(max(deviations * np.sqrt(mine * mine + theirs * theirs), 0.5 * tolerance_mm), tolerance_mm)
                if abs(distance) < limit:
                    agreeing[row, column] += 1
                    total += distance * distance
                elif distance < 0.0:
                    before[row, column] += 1
            if agreeing[row, column] > 0:
                apart[row, column] = total / agreeing[row, column]

"""Holds the compiled loops that cast rays from the axis of a cylinder. The cylinder's axis is y; angles about it are
measured from z towards x."""

import numpy as np

from rig.jit import njit

CELL_MM = 2.0
CELLS_ROUND = 288  # 2 mm at 92 mm from the axis


@njit(cache=True)
def cells_spanned(vertices, face, low, rows):  # pragma: no cover - compiled
    """Returns the range of columns (which may exceed a full turn) and of rows of the grid cells that a triangle may
    touch. ``low`` is the height (mm) of the grid's lower edge."""
    angle0 = np.arctan2(vertices[face[0], 0], vertices[face[0], 2])
    first = last = angle0
    bottom = top = vertices[face[0], 1]
    for k in range(1, 3):
        angle = np.arctan2(vertices[face[k], 0], vertices[face[k], 2])
        angle += 2 * np.pi * np.round((angle0 - angle) / (2 * np.pi))
        first, last = min(first, angle), max(last, angle)
        bottom, top = min(bottom, vertices[face[k], 1]), max(top, vertices[face[k], 1])
    width = 2 * np.pi / CELLS_ROUND
    a, b = int(np.floor((first + np.pi) / width)), int(np.floor((last + np.pi) / width))
    if b - a >= CELLS_ROUND:
        a, b = 0, CELLS_ROUND - 1
    lowest = max(0, int((bottom - low) / CELL_MM))
    return a, b, lowest, min(rows - 1, int((top - low) / CELL_MM))


@njit(cache=True)
def bin_triangles(vertices, faces, low, rows):  # pragma: no cover - compiled
    """Sorts triangles into a cylindrical grid with ``rows`` rows (height) of ``CELLS_ROUND`` cells (angle). Returns
    ``start`` and ``members``: the triangles of cell i are ``members[start[i]:start[i + 1]]``."""
    counts = np.zeros(rows * CELLS_ROUND + 1, np.int64)
    for f in range(len(faces)):
        a, b, c, d = cells_spanned(vertices, faces[f], low, rows)
        for row in range(c, d + 1):
            for column in range(a, b + 1):
                counts[row * CELLS_ROUND + column % CELLS_ROUND + 1] += 1
    start = np.cumsum(counts)
    fill = start[:-1].copy()
    members = np.empty(start[-1], np.int64)
    for f in range(len(faces)):
        a, b, c, d = cells_spanned(vertices, faces[f], low, rows)
        for row in range(c, d + 1):
            for column in range(a, b + 1):
                cell = row * CELLS_ROUND + column % CELLS_ROUND
                members[fill[cell]] = f
                fill[cell] += 1
    return start, members


@njit(cache=True)
def cast_rays(vertices, faces, low, rows, start, members, angles, heights, wanted):  # pragma: no cover - compiled
    """Casts horizontal rays from the y axis, each at an angle (rad) and a height (mm). Returns the radius (mm) of each
    ray's hit: the hit nearest to the ray's ``wanted`` radius, or the outermost hit if ``wanted`` is infinite; NaN
    without a hit.

    Intersections follow Moeller and Trumbore 1997. ``start`` and ``members`` are the results of ``bin_triangles``."""
    radii = np.full(len(angles), np.nan)
    width = 2 * np.pi / CELLS_ROUND
    for k in range(len(angles)):
        row = int(np.floor((heights[k] - low) / CELL_MM))
        if row < 0 or row >= rows:
            continue
        column = int(np.floor((angles[k] + np.pi) / width)) % CELLS_ROUND
        dx, dz = np.sin(angles[k]), np.cos(angles[k])
        best = np.inf
        for m in range(start[row * CELLS_ROUND + column], start[row * CELLS_ROUND + column + 1]):
            face = faces[members[m]]
            p, q, r = vertices[face[0]], vertices[face[1]], vertices[face[2]]
            # Moeller and Trumbore 1997, direction (dx, 0, dz), origin (0, height, 0)
            e1x, e1y, e1z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
            e2x, e2y, e2z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
            hx, hy, hz = -dz * e2y, dz * e2x - dx * e2z, dx * e2y
            det = e1x * hx + e1y * hy + e1z * hz
            if abs(det) < 1e-12:
                continue
            sx, sy, sz = -p[0], heights[k] - p[1], -p[2]
            u = (sx * hx + sy * hy + sz * hz) / det
            if u < -1e-9 or u > 1 + 1e-9:
                continue
            gx, gy, gz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
            v = (dx * gx + dz * gz) / det
            if v < -1e-9 or u + v > 1 + 1e-9:
                continue
            radius = (e2x * gx + e2y * gy + e2z * gz) / det
            if radius <= 0:
                continue
            miss = -radius if wanted[k] == np.inf else abs(radius - wanted[k])
            if miss < best:
                best, radii[k] = miss, radius
    return radii

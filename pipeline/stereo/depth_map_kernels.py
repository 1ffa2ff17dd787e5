"""Compiled loops over the pixels of a depth map, each ray of a crop and each vertex of a surface."""

import numpy as np

from pipeline.geometry.nearest_kernels import COLUMNS, columns_about
from pipeline.geometry.projection_kernels import NEAREST_MM, NOWHERE, distorted, placed
from pipeline.stereo.matching_kernels import HEIGHT, START, UNSEEN_PX, WIDTH
from rig.jit import njit

BESIDE_PX = -1e4  # a place that is in no photograph
FAR_TOLERANCES = np.float32(20.0)  # along a ray: at the steepest slope the planes are then six tolerances apart


@njit(cache=True, nogil=True, error_model="numpy")
def place_known(
    depth: np.ndarray, deviation: np.ndarray, pinhole: np.ndarray, turn: np.ndarray, shift: np.ndarray
) -> np.ndarray:
    """Returns the places (n, 3; world, mm) of the pixels whose ``deviation`` is finite, row by row. ``pinhole`` is fx
    fy cx cy; ``turn`` (3, 3) and ``shift`` (3) are those of world_from_camera."""
    height, width = depth.shape
    count = 0
    for row in range(height):
        for column in range(width):
            count += np.isfinite(deviation[row, column])
    points, n = np.empty((count, 3)), 0
    for row in range(height):
        for column in range(width):
            if np.isfinite(deviation[row, column]):
                z = float(depth[row, column])
                x, y = (column - pinhole[2]) / pinhole[0] * z, (row - pinhole[3]) / pinhole[1] * z
                for axis in range(3):
                    points[n, axis] = turn[axis, 0] * x + turn[axis, 1] * y + turn[axis, 2] * z + shift[axis]
                n += 1
    return points


@njit(cache=True, nogil=True, error_model="numpy")
def normals_of_known(
    depth: np.ndarray, slopes: np.ndarray, known: np.ndarray, pinhole: np.ndarray, turn: np.ndarray
) -> np.ndarray:
    """Returns the unit normals (h, w, 3; world, towards the camera) of the surface at ``known`` pixels, 0 at others,
    from depths (mm) and slopes (h, w, 2; mm a pixel). ``pinhole`` and ``turn`` as in ``place_known``."""
    height, width = depth.shape
    normals = np.zeros((height, width, 3), np.float32)
    for row in range(height):
        for column in range(width):
            if not known[row, column]:
                continue
            x, y = (column - pinhole[2]) / pinhole[0], (row - pinhole[3]) / pinhole[1]
            per_mm = 1.0 / max(float(depth[row, column]), 1.0)
            a, b = slopes[row, column, 0] * pinhole[0] * per_mm, slopes[row, column, 1] * pinhole[1] * per_mm
            c = -(1.0 + x * a + y * b)
            share = 1.0 / np.sqrt(a * a + b * b + c * c)
            for axis in range(3):
                normals[row, column, axis] = (turn[axis, 0] * a + turn[axis, 1] * b + turn[axis, 2] * c) * share
    return normals


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


@njit(cache=True, nogil=True, error_model="numpy")
def _distance_at(distance_px, way, x, y):
    """Signed distance at the nearest pixel; beyond the crop that of its edge."""
    width, height = int(way[WIDTH]), int(way[HEIGHT])
    column = min(max(int(x + 0.5), 0), width - 1)
    row = min(max(int(y + 0.5), 0), height - 1)
    return distance_px[int(way[START]) + row * width + column]


@njit(cache=True, nogil=True, error_model="numpy")
def find_depth_range(start, ways, distance_px, slack_px, low, high, step, near, far):
    """Fills ``near`` and ``far`` (h, w; mm of depth, 0 for none) for the pixels of one view: the first and the last
    depth at which the point of the ray is inside the visual hull. Depths between may be outside.

    Depths from ``low`` to ``high`` are tried at every ``step`` (mm). A point is inside if no view that sees it shows it
    outside the silhouette by more than ``slack_px``, and at least one other view sees it. ``distance_px`` holds the
    signed distances of all views, this view's from ``start`` on; ``ways`` are rows of ``Stack.homographies``.
    """
    height, width = near.shape
    for row in range(height):
        for column in range(width):
            near[row, column] = 0.0
            far[row, column] = 0.0
            here = distance_px[start + row * width + column]
            if here > slack_px or here < UNSEEN_PX:
                continue
            z = low
            while z <= high:
                seen = 0
                for k in range(len(ways)):
                    x, y, depth = placed(ways[k], z * column, z * row, z)
                    if depth < NEAREST_MM:
                        continue
                    distance = _distance_at(distance_px, ways[k], x / depth, y / depth)
                    if distance > slack_px:
                        seen = 0
                        break
                    if distance > UNSEEN_PX:
                        seen += 1
                if seen > 0:
                    if near[row, column] == 0.0:
                        near[row, column] = z
                    far[row, column] = z
                z += step


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def windowed_heights(surface, wanted, keys, spans, window_mm, reach_mm, height_mm, first, last):
    """Fills ``height_mm`` (v) of the ``wanted`` vertices: how far the mean of the vertices around each lies above it,
    along its normal.

    Weights are a Gaussian of ``window_mm`` that ends at ``reach_mm``, times the cosine between both normals where that
    is positive. ``surface`` (6, v) are positions and normals, sorted by the cells as wide as the reach whose ``keys``
    and ``spans`` are those of ``cells.Cells``; so are all other arrays. ``first`` and ``last`` are positions in it.
    """
    ranges, cell = np.empty((COLUMNS, 2), np.int64), -1
    zero, one = np.float32(0.0), np.float32(1.0)
    falloff, most = np.float32(-0.5 / (8.0 * window_mm * window_mm)), np.float32(reach_mm * reach_mm)
    half, third, quarter, fifth = np.float32(1 / 2), np.float32(1 / 3), np.float32(1 / 4), np.float32(1 / 5)
    for position in range(first, last):
        if not wanted[position]:
            continue
        if keys[position] != cell:
            cell = keys[position]
            columns_about(cell, keys, spans, ranges)
        x, y, z, n_x, n_y, n_z = surface[:, position]
        total, weighted = zero, zero
        for column in range(COLUMNS):
            for at in range(ranges[column, 0], ranges[column, 1]):  # without branches: eight vertices at once
                d_x, d_y, d_z = surface[0, at] - x, surface[1, at] - y, surface[2, at] - z
                square = d_x * d_x + d_y * d_y + d_z * d_z
                facing = max(n_x * surface[3, at] + n_y * surface[4, at] + n_z * surface[5, at], zero)
                u = falloff * min(square, most)  # at least -0.4: the series is off by 4e-5 at most
                e = one + u * (one + half * u * (one + third * u * (one + quarter * u * (one + fifth * u))))
                e = e * e * (e * e)
                weight = facing * e * e if square <= most else zero
                total += weight
                weighted += weight * (n_x * d_x + n_y * d_y + n_z * d_z)
        height_mm[position] = weighted / total if total > zero else zero


@njit(cache=True, nogil=True)
def fill_lens_map(crop: np.ndarray, lens: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> None:
    """Fills ``columns`` and ``rows`` (h, w) with the point (px) of the photograph that each pixel of a pinhole camera
    at the same pose shows; ``BESIDE_PX`` if there is none. ``crop`` is fx, fy, cx, cy of the pinhole; ``lens`` that of
    the photograph (``packed_lens``)."""
    height, width = columns.shape
    for row in range(height):
        for column in range(width):
            u, v = distorted((column - crop[2]) / crop[0], (row - crop[3]) / crop[1], lens)
            seen = u < NOWHERE
            columns[row, column] = u if seen else BESIDE_PX
            rows[row, column] = v if seen else BESIDE_PX

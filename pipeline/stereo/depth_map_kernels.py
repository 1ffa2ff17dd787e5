"""Contains the compiled loops that compute on depth maps: points, normals, agreement between views, search ranges,
bias, upsampling, plane fits and the removal of specks.

A speck is a small separate piece of surface, which may be a wrong match. Where skin has no texture, all depths along a
ray match equally well, and overlapping windows make the same error. Matching errors form pieces of a few windows' size,
in front of or behind the surface around them. The pixels of a speck agree with each other, so neither planes of
neighbours nor an average removes it.
"""

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
    """Returns the surface points (n, 3; world frame, mm) of the pixels with finite ``deviation``, row by row.
    ``pinhole`` is fx fy cx cy; ``turn`` (3, 3) and ``shift`` (3) are rotation and translation of world_from_camera."""
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
    """Returns the unit normals (h, w, 3; world frame, towards the camera) at ``known`` pixels, 0 at others, from depths
    (mm) and slopes (h, w, 2; mm per pixel). ``pinhole`` and ``turn`` are as in ``place_known``."""
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
    """Compares the depths (h, w) of one view with other views. Fills in the number of views with the surface at the
    same point (``agreeing``), the number of views that see a surface behind the point (``before``), and the mean
    squared distance to the agreeing surfaces (``apart``, mm^2).

    Two views agree if the point's distance from the other view's plane is below ``tolerance_mm``, and below
    ``deviations`` combined standard deviations (or half of ``tolerance_mm``, if this is more). A view does not count if
    a nearer surface hides the point from it. ``limits`` are ``tolerance_mm`` and ``deviations``. ``depth``, ``slopes``
    and ``deviation`` hold all views one after the other, this view from ``start`` on; ``ways`` are rows of
    ``Stack.homographies``, ``lenses`` fx and fy of the other views.
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
    """Returns another view's signed distance to the outline at the pixel nearest to a projected point."""
    width, height = int(way[WIDTH]), int(way[HEIGHT])
    column = min(max(int(x + 0.5), 0), width - 1)
    row = min(max(int(y + 0.5), 0), height - 1)
    return distance_px[int(way[START]) + row * width + column]


@njit(cache=True, nogil=True, error_model="numpy")
def find_depth_range(start, ways, distance_px, slack_px, low, high, step, near, far):
    """Fills ``near`` and ``far`` (h, w; mm of depth, 0 for none) with the first and the last depth at which each
    pixel's ray is inside the visual hull. Depths between the first and the last may be outside the hull.

    Depths from ``low`` to ``high`` are tested in steps of ``step`` (mm). A point is inside if at least one other view
    sees it, and no other view sees it more than ``slack_px`` outside its silhouette. ``distance_px`` holds the signed
    distances of all views, this view's from index ``start`` on; ``ways`` are rows of ``Stack.homographies``.
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
    """Fills ``height_mm`` (v) of the ``wanted`` vertices with the height, along the normal, of the mean of the surface
    around them.

    Weights are a Gaussian of ``window_mm`` that ends at ``reach_mm``, times the cosine between the two normals if it is
    positive. ``surface`` (6, v) holds positions and normals. All vertex arrays are sorted by the cells of
    ``cells.Cells`` with ``keys`` and ``spans``; a cell is as wide as the reach. ``first`` and ``last`` bound the sorted
    vertices.
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
    """Fills ``columns`` and ``rows`` (h, w) with the point (px) of the photograph for each pixel of a pinhole camera at
    the same pose; ``BESIDE_PX`` if there is none. ``crop`` is fx, fy, cx, cy of the pinhole camera; ``lens`` is the
    photograph's (``packed_lens``)."""
    height, width = columns.shape
    for row in range(height):
        for column in range(width):
            u, v = distorted((column - crop[2]) / crop[0], (row - crop[3]) / crop[1], lens)
            seen = u < NOWHERE
            columns[row, column] = u if seen else BESIDE_PX
            rows[row, column] = v if seen else BESIDE_PX


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def double(depth, slopes, live, depth_out, slopes_out):
    """Upsamples depths and slopes of (h, w) pixels to twice the size. Fills ``depth_out`` (2 h, 2 w) and ``slopes_out``
    at the ``live`` pixels, and 0 elsewhere. A pixel without depth at the smaller size continues the nearest plane
    around it."""
    height, width = depth.shape
    for row in range(2 * height):
        for column in range(2 * width):
            depth_out[row, column] = 0.0
            slopes_out[row, column, 0] = 0.0
            slopes_out[row, column, 1] = 0.0
            if not live[row, column]:
                continue
            x, y = 0.5 * column - 0.25, 0.5 * row - 0.25
            nearest, i0, j0 = 1e9, -1, -1
            for j in range(max(row // 2 - 1, 0), min(row // 2 + 2, height)):
                for i in range(max(column // 2 - 1, 0), min(column // 2 + 2, width)):
                    if depth[j, i] > 0.0:
                        far = (x - i) * (x - i) + (y - j) * (y - j)
                        if far < nearest:
                            nearest, i0, j0 = far, i, j
            if i0 >= 0:
                depth_out[row, column] = depth[j0, i0] + (x - i0) * slopes[j0, i0, 0] + (y - j0) * slopes[j0, i0, 1]
                slopes_out[row, column, 0] = 0.5 * slopes[j0, i0, 0]
                slopes_out[row, column, 1] = 0.5 * slopes[j0, i0, 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def fit_planes(depth, slopes, information, radius, tolerance_mm, steepest, depth_out, slopes_out, relief_mm):
    """Fits a plane to the depths (mm) within ``radius`` pixels of every pixel. Depths are weighted by their
    ``information`` (mm^-2) and by their agreement with the pixel's current plane (half at ``tolerance_mm``), so that
    the fit does not extend across an edge.

    Fills ``depth_out`` (moved to the plane if noise explains the offset), ``slopes_out`` (mm per pixel, at most
    ``steepest``), and ``relief_mm``, the RMS deviation of the depths from the plane. Pixels without depth are left out.
    """
    height, width = depth.shape
    zero, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(1e-9)
    falloff, near = np.float32(1.0 / (tolerance_mm * tolerance_mm)), np.float32(1.0 / (radius * radius))
    # Eight neighbours at once: neither borders nor empty pixels branch, since what is beside them weighs nothing.
    side, stride = 2 * radius + 1, width + 2 * radius
    places, weights = np.zeros((2, (height + 2 * radius) * stride), np.float32)
    for row in range(height):
        for column in range(width):
            if depth[row, column] > zero:
                at = (row + radius) * stride + radius + column
                places[at], weights[at] = depth[row, column], information[row, column]
    steps, (across, down, apart_px) = np.empty(side * side, np.int32), np.empty((3, side * side), np.float32)
    for k in range(side * side):
        j, i = k // side - radius, k % side - radius
        steps[k], across[k], down[k], apart_px[k] = j * stride + i, i, j, one + np.float32(i * i + j * j) * near
    for row in range(height):
        for column in range(width):
            here, z_x, z_y = depth[row, column], slopes[row, column, 0], slopes[row, column, 1]
            depth_out[row, column] = here
            slopes_out[row, column, 0] = z_x
            slopes_out[row, column, 1] = z_y
            relief_mm[row, column] = zero
            if here <= zero:
                continue
            middle = np.int32((row + radius) * stride + radius + column)
            s, s_x, s_y, s_xx, s_xy, s_yy = tiny, zero, zero, tiny, zero, tiny
            s_z, s_xz, s_yz, s_zz = zero, zero, zero, zero
            for k in range(side * side):
                at = np.uint64(np.uint32(middle + steps[k]))
                x, y, z = across[k], down[k], places[at] - here
                off = z - x * z_x - y * z_y
                apart = one + off * off * falloff
                w = weights[at] / (apart * apart * apart_px[k])
                s += w
                s_x += w * x
                s_y += w * y
                s_xx += w * x * x
                s_xy += w * x * y
                s_yy += w * y * y
                s_z += w * z
                s_xz += w * x * z
                s_yz += w * y * z
                s_zz += w * z * z
            x, y, z = s_x / s, s_y / s, s_z / s
            xx, xy, yy = s_xx / s - x * x, s_xy / s - x * y, s_yy / s - y * y
            xz, yz = s_xz / s - x * z, s_yz / s - y * z
            determinant = xx * yy - xy * xy
            if determinant < 0.05 * (radius * radius) * (radius * radius) * 0.05:
                continue
            a = (xz * yy - yz * xy) / determinant
            b = (yz * xx - xz * xy) / determinant
            a, b = min(max(a, -steepest), steepest), min(max(b, -steepest), steepest)
            plane = z - a * x - b * y
            spread = max(s_zz / s - z * z - a * xz - b * yz, 0.0)
            noise = 1.0 / (information[row, column] + 1e-9)
            signal = max(spread - noise, 0.0)
            depth_out[row, column] = here + plane * noise / (signal + noise)
            relief_mm[row, column] = np.sqrt(spread)
            slopes_out[row, column, 0] = a
            slopes_out[row, column, 1] = b


@njit(cache=True, nogil=True, error_model="numpy")
def mark_specks(depth, slopes, gap_mm, most_px, specks):
    """Sets ``specks`` (h, w) at the pixels of every piece of surface that has at most ``most_px`` pixels.

    Neighbouring pixels belong to the same piece if their planes, extended half way to each other, are less than
    ``gap_mm`` apart.
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
    """Replaces depth and slopes at the pixels of ``specks``, in place, by the smoothest surface through the pixels
    around them (least squares of the steps between neighbours), in ``sweeps`` of Gauss-Seidel. A speck without pixels
    around it stays."""
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
    """Returns the sum of the depths of the four neighbouring pixels, except those marked ``left``, and their number."""
    total, sides = 0.0, 0
    for side in range(4):
        j, i = row + (0, 0, 1, -1)[side], column + (1, -1, 0, 0)[side]
        if _in_surface(depth, j, i) and not left[j, i]:
            total += depth[j, i]
            sides += 1
    return total, sides

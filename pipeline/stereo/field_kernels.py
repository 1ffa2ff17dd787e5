"""Compiled loops over images of depth and slopes: doubling their size, planes fitted around each pixel, and specks:
pieces of surface too small to be more than chance matches.

Where skin has no texture, any depth along a ray is as good as another, and overlapping windows make the same error.
They form pieces of a few windows' size, before or behind everything around them. Unlike a single wrong pixel, such a
piece is consistent in itself, so that neither planes of neighbours nor a mean over neighbours removes it.
"""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def double(depth, slopes, live, depth_out, slopes_out):
    """Fills ``depth_out`` (2 h, 2 w) and ``slopes_out`` with the planes of (h, w) pixels at twice the size, at the
    ``live`` pixels (2 h, 2 w), and 0 elsewhere. A pixel whose own parent is empty continues the plane of the nearest
    parent around it."""
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
    """Fits a plane to the depths (mm) around every pixel, within ``radius`` pixels. Depths are weighted by their
    ``information`` (mm^-2), and by how well they agree with the current plane of the pixel (half at ``tolerance_mm``),
    so that the fit does not reach across an edge.

    Fills ``depth_out`` (moved to the plane as far as noise explains the offset), ``slopes_out`` (mm per pixel, at most
    ``steepest``), and ``relief_mm``, the RMS deviation of the depths from the plane. Empty pixels stay empty.
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

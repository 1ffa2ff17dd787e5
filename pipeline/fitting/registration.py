"""What a patch's views say of the cameras: how far each view would like to slide in its image.

At a patch's peak the mean correlation of its views is the least-squares problem ``sum_k v_k |f_k - T|^2``: f_k the
patch's grey values in view k, centred and of unit norm, T their mean with the weights v_k (which eliminates the unknown
texture exactly, and sliding along the surface with it). Linear in the image shifts delta_k (px) of the views,

    H_kl = v_k [k = l] <g_k, g_k> - v_k v_l / V <g_k, g_l>,   gradient_k = v_k <g_k, f_k - T>,

g_k the images' slopes. A displacement u along the normal and camera corrections c_k make ``delta_k = p_k u + C_k c_k``.
Eliminating u leaves how the place that the patch reports leans on the cameras, and a quadratic form in the cameras
alone: shifts that no surface explains. A camera of 0.2 px error shows in thousands of patches.
"""

import numpy as np
from numba import njit, prange

from pipeline.fitting.rim import _project, _projection_jacobian
from pipeline.fitting.sweep import chosen_views

VIEWS_MOST = 8  # of one patch


@njit(cache=True, fastmath=True)
def _read(image, start, width, height, x, y):
    x, y = min(max(x, 0.0), width - 1.001), min(max(y, 0.0), height - 1.001)
    column, row = int(x), int(y)
    fx, fy = x - column, y - row
    i = start + row * width + column
    top = image[i] + fx * (image[i + 1] - image[i])
    bottom = image[i + width] + fx * (image[i + width + 1] - image[i + width])
    return top + fy * (bottom - top)


@njit(cache=True, fastmath=True)
def _fill(members, weights, facing, points, normals, shift, rotation, translation, lens, width, height, start, image,
          noise, shade, slope_x, slope_y):  # fmt: skip
    """Centred grey values of unit norm and their slopes by a shift in the image, of one view of one patch."""
    seen = mean = mean_x = mean_y = 0.0
    place = np.empty(3)
    for i in range(len(members)):
        s = members[i]
        shade[i] = slope_x[i] = slope_y[i] = 0.0
        if facing[s] <= 0:
            continue
        for c in range(3):
            place[c] = points[s, c] + shift * normals[s, c]
        x, y = _project(place, rotation, translation, lens)
        shade[i] = _read(image, start, width, height, x, y)
        slope_x[i] = 0.5 * (
            _read(image, start, width, height, x + 1.0, y) - _read(image, start, width, height, x - 1.0, y)
        )
        slope_y[i] = 0.5 * (
            _read(image, start, width, height, x, y + 1.0) - _read(image, start, width, height, x, y - 1.0)
        )
        seen += weights[i]
        mean += weights[i] * shade[i]
        mean_x += weights[i] * slope_x[i]
        mean_y += weights[i] * slope_y[i]
    energy = along_x = along_y = 0.0
    for i in range(len(members)):
        if facing[members[i]] > 0:
            shade[i] -= mean / seen
            slope_x[i] -= mean_x / seen
            slope_y[i] -= mean_y / seen
            energy += weights[i] * shade[i] * shade[i]
            along_x += weights[i] * shade[i] * slope_x[i]
            along_y += weights[i] * shade[i] * slope_y[i]
    norm = np.sqrt(energy + seen * noise * noise)
    for i in range(len(members)):
        slope_x[i] = (slope_x[i] - along_x / (norm * norm) * shade[i]) / norm
        slope_y[i] = (slope_y[i] - along_y / (norm * norm) * shade[i]) / norm
        shade[i] /= norm


@njit(cache=True, fastmath=True)
def _equations(weights, value, shades, slopes):
    """H (2n, 2n) and the gradient (2n,) of one patch."""
    views, count = len(value), len(weights)
    total = value.sum()
    matrix, gradient = np.zeros((2 * views, 2 * views)), np.zeros(2 * views)
    mean = np.zeros(count)
    for k in range(views):
        for i in range(count):
            mean[i] += value[k] / total * shades[k, i]
    for a in range(2 * views):
        k = a // 2
        for i in range(count):
            gradient[a] += value[k] * weights[i] * slopes[a, i] * (shades[k, i] - mean[i])
        for b in range(a + 1):
            m = b // 2
            product = 0.0
            for i in range(count):
                product += weights[i] * slopes[a, i] * slopes[b, i]
            matrix[a, b] = product * ((value[k] if k == m else 0.0) - value[k] * value[m] / total)
            matrix[b, a] = matrix[a, b]
    return matrix, gradient


@njit(cache=True, parallel=True, fastmath=True)
def register(patches, start, member, weight, facing, points, normals, centres, axes, shifts, rotation, translation,
             lens, size, offset, image, noise, least_share, most):  # fmt: skip
    """Of each of ``patches`` at its ``shifts`` (mm): its views (-1 where fewer), pull (2n: d(place)/d(image shifts)),
    stiffness (2n, 2n) and gradient (2n) of the image shifts once the surface has moved freely, by its own H_uu."""
    count = len(patches)
    views = np.full((count, VIEWS_MOST), -1, np.int64)
    pull = np.zeros((count, 2 * VIEWS_MOST))
    stiff, slope = np.zeros((count, 2 * VIEWS_MOST, 2 * VIEWS_MOST)), np.zeros((count, 2 * VIEWS_MOST))
    for q in prange(count):
        p = patches[q]
        members, weights = member[start[p] : start[p + 1]], weight[start[p] : start[p + 1]]
        order, cosine = chosen_views(members, weights, facing, least_share, min(most, VIEWS_MOST))
        n = len(order)
        shades, slopes = np.empty((n, len(members))), np.empty((2 * n, len(members)))
        value, ahead = np.empty(n), np.empty(2 * n)
        place = centres[q] + shifts[q] * axes[q]
        for j in range(n):
            k = order[j]
            views[q, j], value[j] = k, cosine[k]
            _fill(
                members, weights, facing[k], points, normals, shifts[q], rotation[k], translation[k], lens[k],
                size[k, 0], size[k, 1], offset[k], image, noise[k], shades[j], slopes[2 * j], slopes[2 * j + 1],
            )  # fmt: skip
            jacobian = _projection_jacobian(place, rotation[k], translation[k], lens[k])
            ahead[2 * j] = (jacobian[0] * axes[q]).sum()
            ahead[2 * j + 1] = (jacobian[1] * axes[q]).sum()
        matrix, gradient = _equations(weights, value, shades, slopes)
        across = matrix @ ahead
        own = (ahead * across).sum()
        if own <= 1e-12:
            views[q] = -1
            continue
        down = (ahead * gradient).sum()
        for a in range(2 * n):
            pull[q, a] = -across[a] / own
            slope[q, a] = (gradient[a] - across[a] * down / own) / own
            for b in range(2 * n):
                stiff[q, a, b] = (matrix[a, b] - across[a] * across[b] / own) / own
    return views, pull, stiff, slope


@njit(cache=True)
def gather(views, pull, stiff, slope, information, places, rotation, translation, lens):
    """by_camera (n, 6K), camera_matrix (6K, 6K) and camera_gradient (6K,) of ``surface.SurfaceObservations``."""
    count, cameras = len(views), len(rotation)
    rows, matrix, gradient = np.zeros((count, 6 * cameras)), np.zeros((6 * cameras, 6 * cameras)), np.zeros(6 * cameras)
    for q in range(count):
        n = 0
        while n < views.shape[1] and views[q, n] >= 0:
            n += 1
        slides = np.zeros((2 * n, 6))  # d(pixel) / d(camera): left perturbation, as everywhere
        for j in range(n):
            k = views[q, j]
            # P R^T is the derivative by the point in the camera's frame, where the perturbation acts.
            inner = _projection_jacobian(places[q], rotation[k], translation[k], lens[k]) @ rotation[k].T
            x, y, z = rotation[k] @ places[q] + translation[k]
            for a in range(2):
                gx, gy, gz = inner[a]
                slides[2 * j + a] = np.array([y * gz - z * gy, z * gx - x * gz, x * gy - y * gx, gx, gy, gz])
        for a in range(2 * n):
            first = 6 * views[q, a // 2]
            rows[q, first : first + 6] += pull[q, a] * slides[a]
            gradient[first : first + 6] -= information[q] * slope[q, a] * slides[a]
            for b in range(2 * n):
                second = 6 * views[q, b // 2]
                for i in range(6):
                    for j in range(6):
                        matrix[first + i, second + j] += information[q] * stiff[q, a, b] * slides[a, i] * slides[b, j]
    return rows, matrix, gradient

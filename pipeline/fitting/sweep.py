"""The compiled inner loops of photo-consistency: who sees a sample, and how alike its views are along the normal."""

import numpy as np
from numba import njit, prange

from pipeline.fitting.rim import _project, _projection_jacobian  # the same lens model, compiled once

LEAST_FACING = 0.2  # cosine: at a flatter angle than 78 degrees a pixel smears over 5 times its size
EDGE_PX = 4  # nothing is read nearer to the image's edge
WINDOW_PX = 3  # around a sample in which a nearer surface may blur over it
SLOPE_SLACK = 1.5 * 1.414 * WINDOW_PX  # how much nearer its own slope may bring a surface within the window
LEAST_VIEW = 0.08  # squared cosine of a view that may still speak: 73 degrees


@njit(cache=True, nogil=True)
def project_all(points, rotation, translation, lens):
    """Pixels (n, 2) and camera depths (n,) of world points."""
    pixels, depths = np.empty((len(points), 2)), np.empty(len(points))
    for i in range(len(points)):
        pixels[i, 0], pixels[i, 1] = _project(points[i], rotation, translation, lens)
        depths[i] = translation[2]
        for c in range(3):
            depths[i] += rotation[2, c] * points[i, c]
    return pixels, depths


@njit(cache=True, nogil=True)
def facing_of(points, normals, rotation, translation, lens, depth, distance, hidden_mm, margin_px):
    """Cosine between normal and line of sight for every sample that a camera sees; 0 where it does not.

    ``depth`` is the z-buffer of the head, ``distance`` the silhouette's signed distance.
    """
    out = np.zeros(len(points), np.float32)
    height, width = depth.shape
    centre = -(rotation.T @ translation)
    for i in range(len(points)):
        reach = cosine = 0.0
        for c in range(3):
            towards = centre[c] - points[i, c]
            cosine += towards * normals[i, c]
            reach += towards * towards
        cosine /= np.sqrt(reach)
        if cosine < LEAST_FACING:
            continue
        x, y = _project(points[i], rotation, translation, lens)
        if not (EDGE_PX <= x < width - EDGE_PX - 1 and EDGE_PX <= y < height - EDGE_PX - 1):
            continue
        column, row = int(x + 0.5), int(y + 0.5)
        if distance[row, column] > -margin_px:
            continue
        z = translation[2]
        for c in range(3):
            z += rotation[2, c] * points[i, c]
        nearest = np.inf
        for j in range(row - WINDOW_PX, row + WINDOW_PX + 1):
            for k in range(column - WINDOW_PX, column + WINDOW_PX + 1):
                nearest = min(nearest, depth[j, k])
        slope = min(np.sqrt(1.0 - min(1.0, cosine * cosine)) / cosine, 4.0)
        if z <= nearest + hidden_mm + SLOPE_SLACK * slope * z / lens[0]:
            out[i] = cosine
    return out


@njit(cache=True, parallel=True, fastmath=True)
def sweep(points, normals, facing, rotation, translation, lens, size, offset, image, steps):
    """Grey values (S, K, D) of every sample moved along its normal by ``steps`` (mm), as each camera shows it."""
    samples, views, count = len(points), len(rotation), len(steps)
    out = np.zeros((samples, views, count), np.float32)
    for s in prange(samples):
        for k in range(views):
            if facing[k, s] <= 0:
                continue
            u, v = _project(points[s], rotation[k], translation[k], lens[k])
            slope = _projection_jacobian(points[s], rotation[k], translation[k], lens[k])
            du = dv = 0.0
            for c in range(3):
                du += slope[0, c] * normals[s, c]
                dv += slope[1, c] * normals[s, c]
            width, height = size[k, 0], size[k, 1]
            for d in range(count):
                x = min(max(u + du * steps[d], 0.0), width - 1.001)
                y = min(max(v + dv * steps[d], 0.0), height - 1.001)
                column, row = int(x), int(y)
                fx, fy = np.float32(x - column), np.float32(y - row)
                i = offset[k] + row * width + column
                top = image[i] + fx * (image[i + 1] - image[i])
                bottom = image[i + width] + fx * (image[i + width + 1] - image[i + width])
                out[s, k, d] = top + fy * (bottom - top)
    return out


@njit(cache=True, fastmath=True)
def chosen_views(members, weights, facing, least_share, most):
    """The views that see a patch whole and most frontally, at most ``most``, and the squared cosine of each."""
    views = len(facing)
    value = np.zeros(views)
    total = weights.sum()
    for k in range(views):
        seen = cosine = 0.0
        for i in range(len(members)):
            f = facing[k, members[i]]
            if f > 0:
                seen += weights[i]
                cosine += weights[i] * f
        if seen > least_share * total:
            value[k] = (cosine / seen) ** 2
    order = np.argsort(-value)[:most]
    count = 0
    for k in order:
        if value[k] > LEAST_VIEW:
            count += 1
    return order[:count], value


@njit(cache=True, parallel=True, fastmath=True)
def correlate(start, member, weight, facing, grey, noise, least_share, most):
    """Mean normalised cross-correlation (C, D) over the pairs of the chosen views of each patch, and their number.

    Gain and offset of a view drop out of it. ``noise`` (K,) is the standard deviation of grey values: it stands in the
    norm, so that a patch without texture is like nothing, however alike its noise may look.
    """
    patches, steps = len(start) - 1, grey.shape[2]
    score, used = np.zeros((patches, steps), np.float32), np.zeros(patches, np.int32)
    for p in prange(patches):
        members, weights = member[start[p] : start[p + 1]], weight[start[p] : start[p + 1]]
        order, value = chosen_views(members, weights, facing, least_share, most)
        used[p] = len(order)
        if len(order) < 2:
            continue
        shades = np.empty((len(order), len(members)), np.float32)
        norms = np.empty(len(order))
        for d in range(steps):
            for q in range(len(order)):
                norms[q] = _centred(members, weights, facing[order[q]], grey, order[q], d, noise[order[q]], shades[q])
            total = shared = 0.0
            for q in range(len(order)):
                for r in range(q):
                    product = np.float32(0.0)
                    for i in range(len(members)):
                        product += np.float32(weights[i]) * shades[q, i] * shades[r, i]
                    pair = value[order[q]] * value[order[r]]
                    total += pair * product / (norms[q] * norms[r])
                    shared += pair
            score[p, d] = total / shared
    return score, used


@njit(cache=True, fastmath=True)
def _centred(members, weights, facing, grey, view, step, noise, out):
    """Fills ``out`` with grey values less their weighted mean (0 where unseen); returns their norm, noise included."""
    mean = seen = 0.0
    for i in range(len(members)):
        if facing[members[i]] > 0:
            mean += weights[i] * grey[members[i], view, step]
            seen += weights[i]
    mean /= seen
    energy = 0.0
    for i in range(len(members)):
        out[i] = np.float32(0.0)
        if facing[members[i]] > 0:
            shade = grey[members[i], view, step] - mean
            out[i] = np.float32(shade)
            energy += weights[i] * shade * shade
    return np.sqrt(energy + seen * noise * noise)

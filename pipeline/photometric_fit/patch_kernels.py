"""Holds the compiled loops of photo-consistency: grey values of the views along the normals, their correlation, and the
matrices for the camera corrections (``depth_search`` has the equations). Each thread processes a range of samples or
patches.

Shapes are named as follows: n patches, v views of each patch, a = 2 v image axes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.geometry.projection_kernels import placed, projection_slopes, turned
from pipeline.imaging.sampling_kernels import held, sample_row
from rig.jit import njit


class Samples(NamedTuple):
    """Holds, for k cameras and s samples, the pixel at which a camera sees a sample, the pixel's motion for a step
    along the sample's normal (px per mm), and whether the camera sees the sample."""

    pixel: Float[np.ndarray, "k s 2"]
    along: Float[np.ndarray, "k s 2"]
    seen: Bool[np.ndarray, "k s"]


class Pictures(NamedTuple):
    """Holds the grey images of all cameras one after another in a flat array, row by row."""

    size: Int[np.ndarray, "k 2"]  # width, height
    offset: Int[np.ndarray, " k"]
    image: Float32[np.ndarray, " n"]
    noise: Float[np.ndarray, " k"]  # standard deviation of grey values


class Members(NamedTuple):
    """Holds the samples that belong to each patch, with their weights in the patch's window. The samples of patch p are
    ``member[start[p]:start[p + 1]]``."""

    start: np.ndarray
    member: np.ndarray
    weight: np.ndarray


@njit(cache=True, nogil=True, fastmath=True)
def read(image, start, width, height, x, y):
    """Returns the bilinear value of an image at (x, y), clamped to the image's border. The image begins at index
    ``start`` of the flat array ``image``."""
    x, y = held(x, width), held(y, height)
    column, row = int(x), int(y)
    return sample_row(image, start + row * width + column, width, np.float32(x - column), np.float32(y - row))


@njit(cache=True, nogil=True, fastmath=True)
def sweep_pictures(first, last, samples, pictures, steps, out):
    """Fills ``out`` (s, k, d) for samples ``first`` to ``last``: camera k's grey value at a sample moved along its
    normal by each of ``steps`` (d; mm). Entries of cameras that do not see the sample are not changed."""
    pixel, along, seen = samples
    size, offset, image, _ = pictures
    for s in range(first, last):
        for k in range(len(pixel)):
            if not seen[k, s]:
                continue
            for d in range(len(steps)):
                x = pixel[k, s, 0] + along[k, s, 0] * steps[d]
                y = pixel[k, s, 1] + along[k, s, 1] * steps[d]
                out[s, k, d] = read(image, offset[k], size[k, 0], size[k, 1], x, y)


@njit(cache=True, nogil=True, fastmath=True)
def correlate_views(first, last, members, view, value, seen, grey, noise, score):
    """Fills ``score`` (c, d) for patches ``first`` to ``last``: the weighted mean normalised cross-correlation over all
    pairs of a patch's views, at each of d steps along the normal. Entries of patches with fewer than two views are not
    changed.

    With f the centred grey values of a view and v its weight, the squared norm of ``sum v f / |f|`` contains every pair
    of views twice, and each view with itself once; the latter terms are subtracted. ``view`` and ``value`` (c, n) are
    the views of each patch (-1 for none) and their weights; ``grey`` (s, k, d) is the result of ``sweep_pictures``;
    ``noise`` (k) is part of the norm."""
    start, member, weight = members
    steps = grey.shape[2]
    mean, energy, factor = np.empty(steps, np.float32), np.empty(steps, np.float32), np.empty(steps, np.float32)
    alone = np.empty(steps, np.float32)
    for p in range(first, last):
        begin, count, views = start[p], start[p + 1] - start[p], 0
        while views < view.shape[1] and view[p, views] >= 0:
            views += 1
        if views < 2:
            continue
        mixed = np.zeros((count, steps), np.float32)
        alone[:] = 0.0
        values = squares = 0.0
        for q in range(views):
            k, total = view[p, q], np.float32(0.0)
            mean[:] = 0.0
            energy[:] = 0.0
            for i in range(count):
                s, w = member[begin + i], np.float32(weight[begin + i])
                if seen[k, s]:
                    total += w
                    for d in range(steps):
                        mean[d] += w * grey[s, k, d]
            for d in range(steps):
                mean[d] /= total
            for i in range(count):
                s, w = member[begin + i], np.float32(weight[begin + i])
                if seen[k, s]:
                    for d in range(steps):
                        shade = grey[s, k, d] - mean[d]
                        energy[d] += w * shade * shade
            v, least = np.float32(value[p, q]), np.float32(total * noise[k] * noise[k])
            for d in range(steps):
                square = energy[d] + least
                factor[d] = v / np.sqrt(square)
                alone[d] += v * v * energy[d] / square
            for i in range(count):
                s = member[begin + i]
                if seen[k, s]:
                    for d in range(steps):
                        mixed[i, d] += factor[d] * (grey[s, k, d] - mean[d])
            values += value[p, q]
            squares += value[p, q] * value[p, q]
        energy[:] = 0.0
        for i in range(count):
            w = np.float32(weight[begin + i])
            for d in range(steps):
                energy[d] += w * mixed[i, d] * mixed[i, d]
        for d in range(steps):
            score[p, d] = (energy[d] - alone[d]) / (values * values - squares)


@njit(cache=True, nogil=True, fastmath=True)
def write_image_motion(view, places, axes, cameras, ahead, slides):
    """Fills the derivatives of each patch's pixel position in each of its views: ``ahead`` (n, a; px per mm) by a
    motion of the patch along its axis, and ``slides`` (n, a, 6; px per rad and mm) by a correction of the camera
    (rotation, translation, applied to camera_from_world on the left).

    ``view`` (n, v) are the views, -1 for none; ``places`` and ``axes`` (n, 3) are in the world frame, mm; ``cameras``
    are rows of ``packed_camera``.
    """
    for n in range(len(view)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        for j in range(view.shape[1]):
            if view[n, j] < 0:
                continue
            camera = cameras[view[n, j]]
            px, py, pz = placed(camera, x, y, z)
            for axis, slope in enumerate(projection_slopes(camera, x, y, z)):
                gx, gy, gz = turned(camera, slope[0], slope[1], slope[2])
                row, moved = 2 * j + axis, 0.0
                for c in range(3):
                    moved += slope[c] * axes[n, c]
                ahead[n, row] = moved
                out = slides[n, row]
                out[0], out[1], out[2] = py * gz - pz * gy, pz * gx - px * gz, px * gy - py * gx
                out[3], out[4], out[5] = gx, gy, gz


@njit(cache=True, nogil=True, fastmath=True)
def add_by_camera(view, pull, slides, by_camera):
    """Fills the derivative of each patch's depth by the camera corrections: adds ``pull * slides``, summed over the
    image axes of each view, to the six columns of the view's camera in ``by_camera`` (n, 6 k), in place. ``pull`` (n,
    a) is the derivative of the depth by an image shift, ``slides`` (n, a, 6) that of the shift by the correction."""
    for n in range(len(view)):
        for row in range(pull.shape[1]):
            first = 6 * view[n, row // 2]
            if first < 0:
                continue
            for c in range(6):
                by_camera[n, first + c] += pull[n, row] * slides[n, row, c]


@njit(cache=True, nogil=True, fastmath=True)
def add_cameras(view, stiff, slope, slides, information, matrix, gradient):
    """Sums the quadratic forms in the camera corrections over all patches: adds ``slides^T stiff slides`` to ``matrix``
    (6 k, 6 k) and ``-slides^T slope`` to ``gradient`` (6 k), in place, for k cameras.

    ``stiff`` (n, a, a) and ``slope`` (n, a) are the second and first derivatives of a patch's cost by its image shifts,
    ``slides`` (n, a, 6) the derivatives of these shifts by their camera, ``information`` (n) the weight of the patch,
    and ``view`` (n, v) its cameras, -1 for none.
    """
    pulled = np.empty(6)
    for n in range(len(view)):
        for a in range(stiff.shape[1]):
            here = 6 * view[n, a // 2]
            if here < 0:
                continue
            for c in range(6):
                gradient[here + c] -= information[n] * slope[n, a] * slides[n, a, c]
            for j in range(view.shape[1]):
                there = 6 * view[n, j]
                if there < 0:
                    continue
                for c in range(6):
                    both = stiff[n, a, 2 * j] * slides[n, 2 * j, c] + stiff[n, a, 2 * j + 1] * slides[n, 2 * j + 1, c]
                    pulled[c] = information[n] * both
                for b in range(6):
                    for c in range(6):
                        matrix[here + b, there + c] += slides[n, a, b] * pulled[c]


@njit(cache=True, nogil=True, fastmath=True)
def write_grams(first, last, chosen, members, view, shifts, samples, pictures, slopes, mixed):
    """Fills the inner products of patches ``first`` to ``last`` of ``chosen``: ``slopes`` (n, a, a) between the image
    derivatives of their views, and ``mixed`` (n, a, v) between these derivatives and the grey values.

    Grey values are read with the surface moved by ``shifts`` (n; mm along the normals), weighted, centred and scaled to
    unit norm; the norm includes the noise. The image derivatives (per px) are those of these normalised grey values."""
    start, member, weight = members
    pixel, along, seen = samples
    size, offset, image, noise = pictures
    most = 0
    for q in range(first, last):
        most = max(most, start[chosen[q] + 1] - start[chosen[q]])
    # By view a row each: its grey values, and their slopes; all by the root of the samples' weights.
    rows, roots = np.empty((3 * view.shape[1], most), np.float32), np.empty(most, np.float32)
    for q in range(first, last):
        begin, count, views = start[chosen[q]], start[chosen[q] + 1] - start[chosen[q]], 0
        while views < view.shape[1] and view[q, views] >= 0:
            views += 1
        for i in range(count):
            roots[i] = np.sqrt(weight[begin + i])
        for j in range(views):
            k = view[q, j]
            from_, width, height = offset[k], size[k, 0], size[k, 1]
            shade, turn_x, turn_y = rows[2 * views + j], rows[2 * j], rows[2 * j + 1]
            total = mean = mean_x = mean_y = 0.0
            for i in range(count):
                s, w = member[begin + i], weight[begin + i]
                shade[i] = turn_x[i] = turn_y[i] = 0.0
                if not seen[k, s]:
                    continue
                x = pixel[k, s, 0] + shifts[q] * along[k, s, 0]
                y = pixel[k, s, 1] + shifts[q] * along[k, s, 1]
                shade[i], turn_x[i], turn_y[i] = read_with_slopes(image, from_, width, height, x, y)
                total += w
                mean += w * shade[i]
                mean_x += w * turn_x[i]
                mean_y += w * turn_y[i]
            grey, slope_x, slope_y = np.float32(mean / total), np.float32(mean_x / total), np.float32(mean_y / total)
            energy = along_x = along_y = np.float32(0.0)
            for i in range(count):
                root = roots[i] if seen[k, member[begin + i]] else np.float32(0.0)
                shade[i] = root * (shade[i] - grey)
                turn_x[i] = root * (turn_x[i] - slope_x)
                turn_y[i] = root * (turn_y[i] - slope_y)
                energy += shade[i] * shade[i]
                along_x += shade[i] * turn_x[i]
                along_y += shade[i] * turn_y[i]
            square = energy + np.float32(total * noise[k] * noise[k])
            per, by_x, by_y = np.float32(1.0) / np.sqrt(square), along_x / square, along_y / square
            for i in range(count):  # the slope of what has unit norm
                turn_x[i] = (turn_x[i] - by_x * shade[i]) * per
                turn_y[i] = (turn_y[i] - by_y * shade[i]) * per
                shade[i] *= per
        for a in range(2 * views):
            for b in range(a + 1):
                slopes[q, a, b] = slopes[q, b, a] = _product(rows[a], rows[b], count)
            for b in range(views):
                mixed[q, a, b] = _product(rows[a], rows[2 * views + b], count)


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _product(one, other, count):
    product = np.float32(0.0)
    for i in range(count):
        product += one[i] * other[i]
    return product


@njit(cache=True, nogil=True, fastmath=True)
def read_with_slopes(image, start, width, height, x, y):
    """Returns the bilinear value of an image at (x, y) and its derivatives (per px) along x and y as central
    differences. The image begins at index ``start`` of the flat array ``image``."""
    if not (1.0 <= x < width - 3.0 and 1.0 <= y < height - 3.0):
        across = read(image, start, width, height, x + 1.0, y) - read(image, start, width, height, x - 1.0, y)
        down = read(image, start, width, height, x, y + 1.0) - read(image, start, width, height, x, y - 1.0)
        half = np.float32(0.5)
        return read(image, start, width, height, x, y), half * across, half * down
    column, row = int(x), int(y)
    right, low = np.float32(x - column), np.float32(y - row)
    at = start + row * width + column
    over, here, below, last = at - width, at, at + width, at + 2 * width
    left, far = np.float32(1.0) - right, np.float32(1.0) - low
    top0, top1 = left * image[over] + right * image[over + 1], left * image[last] + right * image[last + 1]
    one, two = left * image[here] + right * image[here + 1], left * image[below] + right * image[below + 1]
    ahead = left * image[here + 1] + right * image[here + 2], left * image[below + 1] + right * image[below + 2]
    behind = left * image[here - 1] + right * image[here], left * image[below - 1] + right * image[below]
    half = np.float32(0.5)
    across = far * (ahead[0] - behind[0]) + low * (ahead[1] - behind[1])
    down = far * (two - top0) + low * (top1 - one)
    return far * one + low * two, half * across, half * down

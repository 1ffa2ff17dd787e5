"""Compiled loops of photo-consistency: the grey values that views show along the normals, and their correlation.
Threads share out the samples or patches."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.imaging.sampling_kernels import held, sample_row
from rig.jit import njit


class Samples(NamedTuple):
    """Holds at which pixel each of k cameras sees each of s samples, how that moves along the sample's normal (px per
    mm), and whether the camera sees it."""

    pixel: Float[np.ndarray, "k s 2"]
    along: Float[np.ndarray, "k s 2"]
    seen: Bool[np.ndarray, "k s"]


class Pictures(NamedTuple):
    """Holds the grey images of all cameras in one flat array, one after the other, row by row."""

    size: Int[np.ndarray, "k 2"]  # width, height
    offset: Int[np.ndarray, " k"]
    image: Float32[np.ndarray, " n"]
    noise: Float[np.ndarray, " k"]  # standard deviation of grey values


class Members(NamedTuple):
    """Holds which samples belong to which patch, with their weights in its window. Those of patch p are
    ``member[start[p]:start[p + 1]]``."""

    start: np.ndarray
    member: np.ndarray
    weight: np.ndarray


@njit(cache=True, nogil=True, fastmath=True)
def read(image, start, width, height, x, y):
    """Returns the bilinear value of an image at (x, y), limited to its inside. The image begins at index ``start`` of
    the flat array ``image``."""
    x, y = held(x, width), held(y, height)
    column, row = int(x), int(y)
    return sample_row(image, start + row * width + column, width, np.float32(x - column), np.float32(y - row))


@njit(cache=True, nogil=True, fastmath=True)
def sweep_pictures(first, last, samples, pictures, steps, out):
    """Fills ``out`` (s, k, d) for samples ``first`` to ``last``: the grey value that camera k shows for a sample that
    is moved along its normal by each of ``steps`` (d; mm). Entries of cameras that do not see the sample are left as
    they are."""
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
    """Fills ``score`` (c, d) for patches ``first`` to ``last``: the mean normalised cross-correlation of each patch's
    views over all their pairs, weighted, at each of d steps along the normal. Patches with fewer than two views are
    left as they are.

    With f the centred grey values of a view and v its weight, the squared norm of ``sum v f / |f|`` holds every pair
    twice, and each view with itself; the latter part is subtracted. ``view`` and ``value`` (c, n) are the views of each
    patch (-1 for none) and their weights; ``grey`` (s, k, d) is the result of ``sweep_pictures``; ``noise`` (k) is part
    of the norm.
    """
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

"""The compiled loops of photo-consistency: what the views show along the normals, and how alike they look.

Plain loops over arrays; threads share them out.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.compute.jit import njit
from pipeline.imaging.sampling_kernels import held, sample_row


class Samples(NamedTuple):
    """Where each camera sees each sample, how that moves along the normal (px / mm), and whether it does."""

    pixel: Float[np.ndarray, "k s 2"]
    along: Float[np.ndarray, "k s 2"]
    seen: Bool[np.ndarray, "k s"]


class Pictures(NamedTuple):
    """Grey images of all cameras, one after the other, row by row."""

    size: Int[np.ndarray, "k 2"]  # width, height
    offset: Int[np.ndarray, " k"]
    image: Float32[np.ndarray, " n"]
    noise: Float[np.ndarray, " k"]  # standard deviation of grey values


class Members(NamedTuple):
    """The samples of patch p are ``member[start[p] : start[p + 1]]``, with their weights in the window."""

    start: np.ndarray
    member: np.ndarray
    weight: np.ndarray


@njit(cache=True, nogil=True, fastmath=True)
def read(image, start, width, height, x, y):
    """The image that begins at ``start`` of the row of images, bilinear, held inside."""
    x, y = held(x, width), held(y, height)
    column, row = int(x), int(y)
    return sample_row(image, start + row * width + column, width, np.float32(x - column), np.float32(y - row))


@njit(cache=True, nogil=True, fastmath=True)
def sweep_pictures(first, last, samples, pictures, steps, out):
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
    """|sum of v f / |f||^2 holds every pair twice, and each view with itself."""
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

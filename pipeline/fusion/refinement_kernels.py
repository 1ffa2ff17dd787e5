"""Compiled loops that measure how far the vertices of a surface are from what the views see there, and smooth these
offsets."""

import numpy as np

from pipeline.fusion.vote_kernels import (
    FLATTEST,
    MAX_VIEWS,
    NORMAL,
    NORMAL_STEP,
    SIGMA,
    SIGMA_STEP_MM,
    UNKNOWN,
    Pixels,
    agreed,
    cosine,
    nearest_pixel,
    seen_at,
)
from pipeline.geometry.projection_kernels import NEAREST_MM
from pipeline.imaging.sampling_kernels import bilinear
from rig.jit import njit

TURNED = 0.4  # cosine between the normals of a vertex and of a pixel below which the pixel shows another surface
STEP_MM = 4.0  # four pixels that differ by more in depth show two surfaces


@njit(cache=True, nogil=True, error_model="numpy")
def measure(
    vertices: np.ndarray,
    normals: np.ndarray,
    seen: Pixels,
    limits: np.ndarray,
    offset: np.ndarray,
    information: np.ndarray,
    scatter: np.ndarray,
    views: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Measures the offset of vertices ``first`` to ``last`` (world, mm) from the surface that the views see, and fills
    arrays with one entry for each vertex.

    ``offset`` is the distance (mm along the vertex normal); ``information`` its inverse variance (mm^-2, views taken as
    independent); ``scatter`` the weighted mean square of the views about it (mm^2); ``views`` the number of views that
    agree. ``limits`` are the distance (mm) beyond which a view shows another surface, the largest difference (mm) of
    agreeing views, and a lower limit of a view's standard deviation (mm).
    """
    cameras, sizes, starts, depths, shown = seen
    gate, agreement, floor = limits
    votes, weights = np.empty(MAX_VIEWS), np.empty(MAX_VIEWS)
    for n in range(first, last):
        place, count = vertices[n], 0
        for v in range(len(cameras)):
            depth, column, row = seen_at(cameras[v], place)
            if depth <= NEAREST_MM:
                continue
            near, beyond = nearest_pixel(column, row, sizes[v])
            near += starts[v]
            if beyond > 0.0 or shown[near, SIGMA] == UNKNOWN:
                continue
            sigma, turn = SIGMA_STEP_MM * shown[near, SIGMA], 0.0
            for axis in range(3):
                turn += NORMAL_STEP * shown[near, NORMAL + axis] * normals[n, axis]
            facing = cosine(cameras[v], place, depth, shown[near])
            if turn < TURNED or facing < FLATTEST:
                continue
            behind = (depth - depth_between(depths, shown, starts[v], sizes[v], column, row, near)) * facing
            if abs(behind) > gate:
                continue
            votes[count] = behind
            weights[count] = min(1.0, 2.0 * facing) / (sigma * sigma * facing * facing + floor * floor)
            count += 1
        mean, _ = agreed(votes, weights, count, agreement)
        total, squares, agreeing = 0.0, 0.0, 0
        for a in range(count):
            if abs(votes[a] - mean) <= agreement:
                total += weights[a]
                squares += weights[a] * (votes[a] - mean) ** 2
                agreeing += 1
        offset[n], information[n], views[n] = mean, total, agreeing
        scatter[n] = squares / total if agreeing else 0.0


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def depth_between(
    depths: np.ndarray, shown: np.ndarray, start: int, size: np.ndarray, column: float, row: float, near: int
) -> float:
    """Returns the depth (mm) at a point between four pixels: interpolated if all four know the depth of one surface,
    else that of the nearest pixel, whose row in ``shown`` is ``near``. ``start`` is the row of the view's first
    pixel."""
    c, r = min(int(column), size[1] - 2), min(int(row), size[0] - 2)
    a = start + r * size[1] + c
    b, d, e = a + 1, a + size[1], a + size[1] + 1
    least = min(min(shown[a, SIGMA], shown[b, SIGMA]), min(shown[d, SIGMA], shown[e, SIGMA]))
    low, high = (
        min(min(depths[a], depths[b]), min(depths[d], depths[e])),
        max(max(depths[a], depths[b]), max(depths[d], depths[e])),
    )
    if least == UNKNOWN or high - low > STEP_MM:
        return depths[near]
    return bilinear(depths[a], depths[b], depths[d], depths[e], column - c, row - r)


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_offsets(
    start: np.ndarray,
    offset: np.ndarray,
    information: np.ndarray,
    starts: np.ndarray,
    indices: np.ndarray,
    root_stiffness: np.ndarray,
    sweeps: int,
    factor: float,
) -> np.ndarray:
    """Returns offsets d (n) smoothed over the mesh: by ``sweeps`` of Gauss-Seidel from ``start``, over-relaxed by
    ``factor``, it minimises ``sum information (d - offset)^2 + sum over edges r r' (d - d')^2``, with the
    ``root_stiffness`` r of the edge's ends. The neighbours of vertex v are ``indices[starts[v]:starts[v + 1]]``."""
    out = start.copy()
    for _ in range(sweeps):
        for v in range(len(out)):
            if root_stiffness[v] == 0.0:
                continue
            total, weight = information[v] * offset[v], information[v]
            for k in range(starts[v], starts[v + 1]):
                edge = root_stiffness[v] * root_stiffness[indices[k]]
                total += edge * out[indices[k]]
                weight += edge
            if weight > 0.0:
                out[v] += factor * (total / weight - out[v])
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def blurred_over_mesh(values: np.ndarray, starts: np.ndarray, indices: np.ndarray, steps: int) -> np.ndarray:
    """Returns values (n, k) at vertices after ``steps`` in each of which a vertex takes the mean of its own and its
    neighbours' mean. The neighbours of vertex v are ``indices[starts[v]:starts[v + 1]]``."""
    one, other, last = values.copy(), np.empty_like(values), values.shape[1] - 1
    for _ in range(steps):
        for v in range(len(values)):
            first, end = np.uint32(starts[v]), np.uint32(starts[v + 1])
            share = 0.5 / max(end - first, 1)
            for c in range(0, last + 1, 2):  # two columns at a time; an odd last one twice
                d = min(c + 1, last)
                total, beside = 0.0, 0.0
                for k in range(first, end):
                    at = np.uint32(indices[k])
                    total += one[at, c]
                    beside += one[at, d]
                other[v, c] = 0.5 * one[v, c] + share * total
                other[v, d] = 0.5 * one[v, d] + share * beside
        one, other = other, one
    return one

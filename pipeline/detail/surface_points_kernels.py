"""Contains the compiled loops of ``pipeline.detail.dense_points``."""

import numpy as np

from rig.jit import njit

SIDES, PARTS = 6, 4  # main directions of a normal; codes of ``Part``, at most


@njit(cache=True, nogil=True, error_model="numpy")
def cell_numbers(points: np.ndarray, normals: np.ndarray, part: np.ndarray, cell_mm: float) -> np.ndarray:
    """Assigns each of the points (n, 3) to a group by grid cell, ``part`` and main direction of the normal. Returns the
    group numbers."""
    low, cells = np.full(3, np.inf), np.zeros(3, np.int64)
    for axis in range(3):
        high = -np.inf
        for n in range(len(points)):
            low[axis], high = min(low[axis], points[n, axis]), max(high, points[n, axis])
        cells[axis] = int(np.floor((high - low[axis]) / cell_mm)) + 1
    numbers = np.empty(len(points), np.int64)
    for n in range(len(points)):
        number = 0
        for axis in range(3):
            number = number * cells[axis] + int(np.floor((points[n, axis] - low[axis]) / cell_mm))
        side = 0
        for axis in range(1, 3):
            if abs(normals[n, axis]) > abs(normals[n, side]):
                side = axis
        numbers[n] = (number * SIDES + 2 * side + (normals[n, side] > 0.0)) * PARTS + part[n]
    return numbers


@njit(cache=True, nogil=True, error_model="numpy")
def mean_points(
    group: np.ndarray, count: int, points: np.ndarray, normals: np.ndarray, deviation: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns the mean point, unit mean normal, standard deviation and part of ``count`` groups of points (n, 3),
    weighted by information. The standard deviation is that of a single point."""
    place, towards, single = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
    total, of = np.zeros(count), np.zeros(count, np.uint8)
    for n in range(len(group)):
        g, information = group[n], 1.0 / deviation[n] ** 2
        for axis in range(3):
            place[g, axis] += information * points[n, axis]
            towards[g, axis] += information * normals[n, axis]
        total[g] += information
        single[g] += 1.0
        of[g] = part[n]
    for g in range(count):
        length = 0.0
        for axis in range(3):
            place[g, axis] /= total[g]
            towards[g, axis] /= total[g]
            length += towards[g, axis] ** 2
        towards[g] /= max(np.sqrt(length), 1e-9)
        single[g] = np.sqrt(single[g] / total[g])
    return place, towards, single, of

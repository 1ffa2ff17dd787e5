"""Compiled loop that computes the mean of a surface over a window around each of its vertices."""

import numpy as np

from pipeline.geometry.cell_kernels import COLUMNS, columns_about
from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def windowed_heights(
    vertices: np.ndarray,
    normals: np.ndarray,
    wanted: np.ndarray,
    order: np.ndarray,
    keys: np.ndarray,
    spans: np.ndarray,
    window_mm: float,
    reach_mm: float,
    height_mm: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Fills ``height_mm`` (v) of the ``wanted`` vertices: how far the mean of the vertices around each lies above it,
    along its normal.

    Weights are a Gaussian of ``window_mm`` that ends at ``reach_mm``, times the cosine between both normals where that
    is positive. ``order``, ``keys`` and ``spans`` are those of ``cells.Cells``, with cells as wide as the reach;
    ``first`` and ``last`` are positions in that order.
    """
    ranges, cell = np.empty((COLUMNS, 2), np.int64), -1
    falloff, most = -0.5 / (window_mm * window_mm), reach_mm * reach_mm
    for position in range(first, last):
        vertex = order[position]
        if not wanted[vertex]:
            continue
        if keys[position] != cell:
            cell = keys[position]
            columns_about(cell, keys, spans, ranges)
        x, y, z = vertices[vertex]
        n_x, n_y, n_z = normals[vertex]
        total, weighted = 0.0, 0.0
        for column in range(COLUMNS):
            for at in range(ranges[column, 0], ranges[column, 1]):
                other = order[at]
                d_x, d_y, d_z = vertices[other, 0] - x, vertices[other, 1] - y, vertices[other, 2] - z
                square = d_x * d_x + d_y * d_y + d_z * d_z
                if square > most:
                    continue
                facing = n_x * normals[other, 0] + n_y * normals[other, 1] + n_z * normals[other, 2]
                if facing <= 0.0:
                    continue
                weight = facing * np.exp(falloff * square)
                total += weight
                weighted += weight * (n_x * d_x + n_y * d_y + n_z * d_z)
        height_mm[vertex] = weighted / total if total > 0.0 else 0.0

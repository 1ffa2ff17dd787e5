"""Compiled loop that computes the mean of a surface over a window around each of its vertices."""

import numpy as np

from pipeline.geometry.cell_kernels import COLUMNS, columns_about
from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def windowed_heights(surface, wanted, keys, spans, window_mm, reach_mm, height_mm, first, last):
    """Fills ``height_mm`` (v) of the ``wanted`` vertices: how far the mean of the vertices around each lies above it,
    along its normal.

    Weights are a Gaussian of ``window_mm`` that ends at ``reach_mm``, times the cosine between both normals where that
    is positive. ``surface`` (6, v) are positions and normals, sorted by the cells as wide as the reach whose ``keys``
    and ``spans`` are those of ``cells.Cells``; so are all other arrays. ``first`` and ``last`` are positions in it.
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

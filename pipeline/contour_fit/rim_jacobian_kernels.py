"""Compiled inner loop of the rim's Jacobian: one row for each rim sample, written in place."""

from typing import NamedTuple

import numpy as np

from pipeline.geometry.projection_kernels import placed, turned
from rig.jit import njit

POSE = 7  # rotation, translation, log scale


class Level(NamedTuple):
    """Holds a mesh level's operator from the cage (compressed sparse rows: ``indptr``, ``indices``, ``data``), and the
    modes of the cage (v0, 3, m; head frame, mm)."""

    indptr: np.ndarray
    indices: np.ndarray
    data: np.ndarray
    modes: np.ndarray


class RimSamples(NamedTuple):
    """Holds the columns of ``rim.Rim`` that its Jacobian needs, one row each for a sample."""

    view: np.ndarray
    corner: np.ndarray
    blend: np.ndarray
    point: np.ndarray
    gradient: np.ndarray


@njit(cache=True, nogil=True, fastmath=True)
def fill_rows(first, last, level, count, turn, place, cameras, rim, out):
    """Fills the Jacobian rows ``out[first:last]`` of rim samples: the derivative of the residual (px) by ``count``
    coefficients, by pose (rotation, translation, log scale) and by the correction of the camera that sees the sample
    (rotation, translation). The equations are in ``rim_term``.

    ``turn`` is scale times rotation (3, 3) and ``place`` the translation (3, mm) of world_from_head; ``cameras`` has
    the rows of ``Views.packed``. By the coefficients the derivative is gradient . mode, summed over the cage with the
    weights of the level's operator and of the sample on its edge.
    """
    indptr, indices, data, modes = level
    view, corner, blend, point, gradient = rim
    for s in range(first, last):
        gx, gy, gz = gradient[s, 0], gradient[s, 1], gradient[s, 2]
        hx = gx * turn[0, 0] + gy * turn[1, 0] + gz * turn[2, 0]
        hy = gx * turn[0, 1] + gy * turn[1, 1] + gz * turn[2, 1]
        hz = gx * turn[0, 2] + gy * turn[1, 2] + gz * turn[2, 2]
        row = np.zeros(count, np.float32)
        for end in range(2):
            share = blend[s] if end else 1.0 - blend[s]
            v = corner[s, end]
            for j in range(indptr[v], indptr[v + 1]):
                i, w = indices[j], share * data[j]
                wx, wy, wz = np.float32(w * hx), np.float32(w * hy), np.float32(w * hz)
                for m in range(count):
                    row[m] += wx * modes[i, 0, m] + wy * modes[i, 1, m] + wz * modes[i, 2, m]
        for m in range(count):
            out[s, m] = row[m]
        _fill_rigid(point[s, 0] - place[0], point[s, 1] - place[1], point[s, 2] - place[2], gx, gy, gz, out[s], count)
        out[s, count + 6] = (
            gx * (point[s, 0] - place[0]) + gy * (point[s, 1] - place[1]) + gz * (point[s, 2] - place[2])
        )
        camera = cameras[view[s]]
        x, y, z = placed(camera, point[s, 0], point[s, 1], point[s, 2])
        ax, ay, az = turned(camera, gx, gy, gz)
        _fill_rigid(x, y, z, ax, ay, az, out[s], count + POSE)


@njit(cache=True, fastmath=True)
def _fill_rigid(x, y, z, gx, gy, gz, out, first):
    """Rotation and translation: g . (w x arm) = w . (arm x g), and g."""
    out[first], out[first + 1], out[first + 2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    out[first + 3], out[first + 4], out[first + 5] = gx, gy, gz

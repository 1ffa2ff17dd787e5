"""The cylindrical projection of section 3.2: rays from the vertical axis through the head, outwards.

A ray is (angle, height): angle 0 looks along +z (out of the face), pi/2 along +x (the subject's left), height is y.
The compiled loops test a ray against the triangles of its cell in an (angle, height) grid, and nothing else.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit

_CELL_MM = 2.0
_CELLS_ROUND = 288  # 2 mm at 92 mm from the axis


@dataclass(frozen=True, slots=True, eq=False)
class Cast:
    """Where rays meet a surface; NaN and -1 where they do not."""

    radii: Float[np.ndarray, " N"]
    triangles: Int[np.ndarray, " N"]


def coordinates(points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, " N"], ...]:
    """Angle (-pi to pi), height and radius of points about the axis x = z = 0."""
    return np.arctan2(points[:, 0], points[:, 2]), points[:, 1], np.hypot(points[:, 0], points[:, 2])


def points_at(
    angles: Float[np.ndarray, " N"], heights: Float[np.ndarray, " N"], radii: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "N 3"]:
    """The inverse of ``coordinates``."""
    return np.stack([radii * np.sin(angles), heights, radii * np.cos(angles)], 1)


class CylinderIndex:
    """A triangle surface (mm, axis x = z = 0) prepared for rays from the axis."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self._vertices = np.ascontiguousarray(vertices, float)
        self._faces = np.ascontiguousarray(faces, np.int64)
        self._low = float(vertices[:, 1].min())
        self._rows = int((vertices[:, 1].max() - self._low) / _CELL_MM) + 1
        self._start, self._members = _binned(self._vertices, self._faces, self._low, self._rows)

    def cast(
        self,
        angles: Float[np.ndarray, " N"],
        heights: Float[np.ndarray, " N"],
        near: Float[np.ndarray, " N"] | None = None,
    ) -> Cast:
        """The hit nearest in radius to ``near``, or the outermost one, of each ray."""
        wanted = np.full(len(angles), np.inf) if near is None else np.asarray(near, float)
        found, triangles = _cast(
            self._vertices, self._faces, self._low, self._rows, self._start, self._members, angles, heights, wanted
        )
        return Cast(found, triangles)


@njit(cache=True)
def _span(vertices, face, low, rows):  # pragma: no cover - compiled
    """First and last column (unwrapped) and row of the cells that a triangle may touch."""
    angle0 = np.arctan2(vertices[face[0], 0], vertices[face[0], 2])
    first = last = angle0
    bottom = top = vertices[face[0], 1]
    for k in range(1, 3):
        angle = np.arctan2(vertices[face[k], 0], vertices[face[k], 2])
        angle += 2 * np.pi * np.round((angle0 - angle) / (2 * np.pi))
        first, last = min(first, angle), max(last, angle)
        bottom, top = min(bottom, vertices[face[k], 1]), max(top, vertices[face[k], 1])
    width = 2 * np.pi / _CELLS_ROUND
    a, b = int(np.floor((first + np.pi) / width)), int(np.floor((last + np.pi) / width))
    if b - a >= _CELLS_ROUND:
        a, b = 0, _CELLS_ROUND - 1
    lowest = max(0, int((bottom - low) / _CELL_MM))
    return a, b, lowest, min(rows - 1, int((top - low) / _CELL_MM))


@njit(cache=True)
def _binned(vertices, faces, low, rows):  # pragma: no cover - compiled
    counts = np.zeros(rows * _CELLS_ROUND + 1, np.int64)
    for f in range(len(faces)):
        a, b, c, d = _span(vertices, faces[f], low, rows)
        for row in range(c, d + 1):
            for column in range(a, b + 1):
                counts[row * _CELLS_ROUND + column % _CELLS_ROUND + 1] += 1
    start = np.cumsum(counts)
    fill = start[:-1].copy()
    members = np.empty(start[-1], np.int64)
    for f in range(len(faces)):
        a, b, c, d = _span(vertices, faces[f], low, rows)
        for row in range(c, d + 1):
            for column in range(a, b + 1):
                cell = row * _CELLS_ROUND + column % _CELLS_ROUND
                members[fill[cell]] = f
                fill[cell] += 1
    return start, members


@njit(cache=True)
def _cast(vertices, faces, low, rows, start, members, angles, heights, wanted):  # pragma: no cover - compiled
    radii, triangles = np.full(len(angles), np.nan), np.full(len(angles), -1, np.int64)
    width = 2 * np.pi / _CELLS_ROUND
    for k in range(len(angles)):
        row = int(np.floor((heights[k] - low) / _CELL_MM))
        if row < 0 or row >= rows:
            continue
        column = int(np.floor((angles[k] + np.pi) / width)) % _CELLS_ROUND
        dx, dz = np.sin(angles[k]), np.cos(angles[k])
        best = np.inf
        for m in range(start[row * _CELLS_ROUND + column], start[row * _CELLS_ROUND + column + 1]):
            face = faces[members[m]]
            p, q, r = vertices[face[0]], vertices[face[1]], vertices[face[2]]
            # Moeller and Trumbore 1997, direction (dx, 0, dz), origin (0, height, 0)
            e1x, e1y, e1z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
            e2x, e2y, e2z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
            hx, hy, hz = -dz * e2y, dz * e2x - dx * e2z, dx * e2y
            det = e1x * hx + e1y * hy + e1z * hz
            if abs(det) < 1e-12:
                continue
            sx, sy, sz = -p[0], heights[k] - p[1], -p[2]
            u = (sx * hx + sy * hy + sz * hz) / det
            if u < -1e-9 or u > 1 + 1e-9:
                continue
            gx, gy, gz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
            v = (dx * gx + dz * gz) / det
            if v < -1e-9 or u + v > 1 + 1e-9:
                continue
            radius = (e2x * gx + e2y * gy + e2z * gz) / det
            if radius <= 0:
                continue
            miss = -radius if wanted[k] == np.inf else abs(radius - wanted[k])
            if miss < best:
                best = miss
                radii[k], triangles[k] = radius, members[m]
    return radii, triangles

"""Holds the measured surface as points with normals."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Holds n points of the visible surface in the world frame, each with its normal, its standard deviation, and the
    part of the subject that it shows."""

    points: Float[np.ndarray, "n 3"]  # mm
    normals: Float[np.ndarray, "n 3"]  # unit, outwards
    deviation_mm: Float[np.ndarray, " n"]  # along the normal
    part: UInt8[np.ndarray, " n"]  # codes of ``Part``

    def chosen(self, rows: Bool[np.ndarray, " n"] | Int[np.ndarray, " m"]) -> "SurfacePoints":
        """Returns the points of the chosen rows."""
        return SurfacePoints(self.points[rows], self.normals[rows], self.deviation_mm[rows], self.part[rows])


def with_scaled_deviation(surface: SurfacePoints, factor: float | Float[np.ndarray, " n"]) -> SurfacePoints:
    """Returns the points with ``factor`` times their deviation."""
    return replace(surface, deviation_mm=factor * surface.deviation_mm)


def thinned(surface: SurfacePoints, cell_mm: float) -> SurfacePoints:
    """Thins out points: returns the mean, weighted by information, of the points in each cell of a grid, for each part
    of the subject and main direction of the normal.

    The deviation remains that of a single point: neighbouring points have nearly the same error, since their windows
    overlap.

    Args:
        surface: points, mm.
        cell_mm: edge of a cell.

    Returns:
        The means, in the order of the cells.
    """
    if not len(surface.points):
        return surface
    cell = np.floor((surface.points - surface.points.min(axis=0)) / cell_mm).astype(np.int64)
    side = np.argmax(np.abs(surface.normals), axis=1)
    side = 2 * side + (np.take_along_axis(surface.normals, side[:, None], axis=1)[:, 0] > 0)
    size = cell.max(axis=0) + 1
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    _, group = np.unique((key * 6 + side) * 4 + surface.part, return_inverse=True)
    information = 1.0 / surface.deviation_mm**2
    total, count = np.bincount(group, information), np.bincount(group)

    def mean(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        return np.stack([np.bincount(group, information * values[:, k]) for k in range(3)], axis=1) / total[:, None]

    normals = mean(surface.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    part = np.zeros(len(total), np.uint8)
    part[group] = surface.part
    return SurfacePoints(mean(surface.points), normals / np.maximum(length, 1e-9), np.sqrt(count / total), part)

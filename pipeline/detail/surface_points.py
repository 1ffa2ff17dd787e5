"""Holds the measured surface as points with normals."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.detail.surface_points_kernels import cell_numbers, mean_points


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
    points, normals, deviation = (
        np.ascontiguousarray(each, float) for each in (surface.points, surface.normals, surface.deviation_mm)
    )
    part = np.ascontiguousarray(surface.part)
    numbers, group = np.unique(cell_numbers(points, normals, part, cell_mm), return_inverse=True)
    return SurfacePoints(*mean_points(group, len(numbers), points, normals, deviation, part))

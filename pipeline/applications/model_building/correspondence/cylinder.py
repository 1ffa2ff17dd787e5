"""Casts rays from the vertical axis through the head outwards: the cylindrical projection of section 3.2.

A ray is (angle, height): angle 0 looks along +z (out of the face), pi/2 along +x (the subject's left); height is y. The
compiled loops test a ray only against the triangles of its cell in an (angle, height) grid."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.applications.model_building.correspondence.cylinder_kernels import CELL_MM, bin_triangles, cast_rays

PerVertex = Float[np.ndarray, " N"]


@dataclass(frozen=True, slots=True, eq=False)
class Cast:
    """Holds where rays meet a surface: radius (mm) and triangle, NaN and -1 where they do not."""

    radii: PerVertex
    triangles: Int[np.ndarray, " N"]


def coordinates(points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, " _"], ...]:
    """Returns angle (-pi to pi), height and radius (mm) of points about the axis x = z = 0."""
    return np.arctan2(points[:, 0], points[:, 2]), points[:, 1], np.hypot(points[:, 0], points[:, 2])


def points_at(angles: PerVertex, heights: PerVertex, radii: PerVertex) -> Float[np.ndarray, "N 3"]:
    """Returns points from angle, height and radius: the inverse of ``coordinates``."""
    return np.stack([radii * np.sin(angles), heights, radii * np.cos(angles)], 1)


class CylinderIndex:
    """Holds a triangle surface (mm, axis x = z = 0) prepared for rays from the axis."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self._vertices = np.ascontiguousarray(vertices, float)
        self._faces = np.ascontiguousarray(faces, np.int64)
        self._low = float(vertices[:, 1].min())
        self._rows = int((vertices[:, 1].max() - self._low) / CELL_MM) + 1
        self._start, self._members = bin_triangles(self._vertices, self._faces, self._low, self._rows)

    def cast(self, angles: PerVertex, heights: PerVertex, near: PerVertex | None = None) -> Cast:
        """Returns each ray's hit whose radius is nearest to ``near`` (mm), or without ``near`` the outermost hit."""
        wanted = np.full(len(angles), np.inf) if near is None else np.asarray(near, float)
        found, triangles = cast_rays(
            self._vertices, self._faces, self._low, self._rows, self._start, self._members, angles, heights, wanted
        )
        return Cast(found, triangles)

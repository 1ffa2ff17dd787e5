"""Assigns each measured surface point to the closest point of the head with a similar normal.

The search for pairs goes from the measured points to the head. With this direction, parts of the head without measured
points, and the borders of such holes, get no observation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.compute.threads import in_threads
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.surface_index import corners_at_vertices
from pipeline.geometry.surface_kernels import FannedMesh, closest_at_vertices

Faces = Int[np.ndarray, "f 3"]

CANDIDATES = 4  # vertices whose triangles are tried


@dataclass(frozen=True, slots=True, eq=False)
class Associated:
    """Holds the indices of the n surface points near a head, and the closest point on the head's mesh for each."""

    row: Int[np.ndarray, " n"]  # of the points asked for
    triangle: Int[np.ndarray, " n"]
    blend: Float[np.ndarray, "n 3"]  # barycentric weights of its corners
    distance_mm: Float[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Holds a head's mesh with a search tree for closest points."""

    head: FannedMesh
    tree: PointTree
    corner_mm: float  # from no place of a triangle is its nearest corner farther

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "v 3"], vertex_normals: Float[np.ndarray, "v 3"], faces: Faces) -> "Target":
        """Builds a target from a mesh (mm) with unit vertex normals."""
        sides = [np.linalg.norm(vertices[faces[:, j]] - vertices[faces[:, j - 1]], axis=1) for j in range(3)]
        start, corner = corners_at_vertices(faces, len(vertices))
        head = FannedMesh(vertices, vertex_normals, faces, start, corner // 3)
        return cls(head, PointTree.of(vertices), float(np.max(sides, initial=0.0)))

    def closest(
        self,
        points: Float[np.ndarray, "p 3"],
        normals: Float[np.ndarray, "p 3"],
        *,
        reach_mm: float,
        least_agreement: float,
    ) -> Associated:
        """Finds, for each surface point, the closest point on the head within reach.

        Args:
            points: measured surface points, mm, in the head's frame.
            normals: unit, outwards.
            reach_mm: points farther away are left out.
            least_agreement: smallest cosine between a point's normal and the head's.

        Returns:
            The points that have a closest point within reach, in their order.
        """
        count = min(CANDIDATES, len(self.head.vertices))
        within = reach_mm + self.corner_mm
        _, near = nearest(self.tree, points, count=count, within=within)
        near = near.reshape(len(points), count)
        triangle = np.empty(len(points), np.int64)
        blend, square = np.zeros((len(points), 3)), np.empty(len(points))

        def fill(first: int, last: int) -> None:
            closest_at_vertices(first, last, points, normals, near, self.head, least_agreement, triangle, blend, square)

        in_threads(len(points), fill)
        row = np.flatnonzero((triangle >= 0) & (square <= reach_mm**2))
        return Associated(row, triangle[row], blend[row], np.sqrt(square[row]))


def interpolated(corners: Float[np.ndarray, "n 3 3"], blend: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Interpolates values at n points inside triangles from the three corners, with barycentric coordinates
    ``blend``."""
    return np.einsum("nk,nkc->nc", blend, corners)

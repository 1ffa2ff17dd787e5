"""Finds closest points on triangle surfaces, exactly among the triangles near the closest surface samples; also lists
the faces around each vertex.

All lengths are in mm, and points and surface in one common frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Int64

from pipeline.compute.threads import in_threads
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.surface_kernels import closest_of_candidates, cosines_towards, sort_corners


def closest_candidates(
    points: Float[np.ndarray, "n 3"],
    candidates: Int[np.ndarray, "n c"],
    corners: Float[np.ndarray, "f 3 3"],
    facing: Float[np.ndarray, "n 3"] | None = None,
    facing_mm: float = 0.0,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Finds, for each point, the closest of its candidate triangles, and the barycentric coordinates of the closest
    point on it.

    Args:
        points: the query points.
        candidates: indices into ``corners`` for each point; of equally close triangles the first is chosen.
        corners: corner positions of all triangles.
        facing: unit normals of the points; a triangle that faces the opposite way counts as ``facing_mm`` farther away.
        facing_mm: the additional distance.
    """
    triangle, weights = np.zeros(len(points), np.int64), np.zeros((len(points), 3))
    places, rows = np.ascontiguousarray(points, float), np.ascontiguousarray(candidates, np.int64)
    shape = np.ascontiguousarray(corners, float)
    normals = np.zeros((0, 3)) if facing is None else np.ascontiguousarray(facing, float)

    def work(first: int, last: int) -> None:
        closest_of_candidates(first, last, places, rows, shape, normals, float(facing_mm), triangle, weights)

    in_threads(len(points), work)
    return triangle, weights


_CANDIDATES = 6


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Holds, for each query point, its closest point on the surface, the triangle of this point, its barycentric
    weights, its normal, and the distance."""

    points: Float[np.ndarray, "N 3"]
    triangles: Int[np.ndarray, " N"]  # row of ``faces``
    weights: Float[np.ndarray, "N 3"]
    distances: Float[np.ndarray, " N"]
    normals: Float[np.ndarray, "N 3"]  # unit, of the triangles


class SurfaceIndex:
    """Holds a triangle surface prepared for closest-point queries. ``spacing`` (mm) bounds the gap between samples."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], spacing: float = 2.0) -> None:
        self.faces = faces
        self.corners = vertices[faces]
        samples, self._owner = _samples(self.corners, spacing)
        self._tree = PointTree.of(samples)

    def closest(
        self,
        points: Float[np.ndarray, "N 3"],
        candidates: int = _CANDIDATES,
        *,
        facing: Float[np.ndarray, "N 3"] | None = None,
        facing_mm: float = 10.0,
    ) -> Hits:
        """Finds the closest surface point of each query point. If unit normals ``facing`` of the points are given, a
        triangle that faces the opposite way is chosen only if it is nearer by ``facing_mm``; this keeps touching lips
        apart."""
        count = min(candidates, len(self._owner))
        near = nearest(self._tree, points, count=count)[1].reshape(len(points), count)
        triangle, weights = closest_candidates(points, self._owner[near], self.corners, facing, facing_mm)
        found = np.einsum("nk,nkx->nx", weights, self.corners[triangle])
        return Hits(found, triangle, weights, np.linalg.norm(points - found, axis=1), self.normals(triangle))

    def normals(self, triangles: Int[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
        """Returns the unit normals of the given triangles."""
        corners = self.corners[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)


def _samples(
    corners: Float[np.ndarray, "F 3 3"], spacing: float
) -> tuple[Float[np.ndarray, "S 3"], Int[np.ndarray, " S"]]:
    """Returns sample points on the triangles and the triangle of each sample: the centroid, and more points in large
    triangles."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1)
    parts = np.clip(np.ceil(longest / spacing / 1.5), 1, 12).astype(int)
    points, owner = [], []
    for n in np.unique(parts):
        faces = np.flatnonzero(parts == n)
        grid = np.array([(i, j, n - 1 - i - j) for i in range(n) for j in range(n - i)]) + 1 / 3
        weights = grid / n
        points.append(np.einsum("gk,fkx->fgx", weights, corners[faces]).reshape(-1, 3))
        owner.append(np.repeat(faces, len(weights)))
    return np.concatenate(points), np.concatenate(owner)


def corners_at_vertices(
    faces: Int[np.ndarray, "f 3"], count: int
) -> tuple[Int64[np.ndarray, " v1"], Int64[np.ndarray, " e"]]:
    """Returns the face corners at each of ``count`` vertices in compressed rows: the corners at vertex i are
    ``corner[start[i]:start[i + 1]]``. Corner 3 f + k is the k-th corner of face f."""
    return sort_corners(np.array(faces, np.int32, order="C"), count)


def facing_cosine(
    place: Float[np.ndarray, " 3"], points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Returns the cosine between the unit normal of each point and the direction from the point to another point."""
    return cosines_towards(
        np.ascontiguousarray(place, float), np.ascontiguousarray(points, float), np.ascontiguousarray(normals, float)
    )

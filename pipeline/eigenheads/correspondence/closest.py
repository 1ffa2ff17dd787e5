"""Closest points on triangle surfaces, exact over the triangles around the nearest samples of them.

Point to triangle: the foot of the perpendicular where it lies inside, else the best point of the three edges
(C. Ericson, *Real-Time Collision Detection*, 2005, section 5.1.5).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

_CANDIDATES = 6


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """For each query point: its closest point, the triangle that holds it, barycentric weights, and the distance."""

    points: Float[np.ndarray, "N 3"]
    triangles: Int[np.ndarray, " N"]  # row of ``faces``
    weights: Float[np.ndarray, "N 3"]
    distances: Float[np.ndarray, " N"]
    normals: Float[np.ndarray, "N 3"]  # unit, of the triangles


class SurfaceIndex:
    """A triangle surface prepared for closest-point queries. ``spacing`` (mm) bounds the gap between samples."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], spacing: float = 2.0) -> None:
        self.faces = faces
        self.corners = vertices[faces]
        samples, self._owner = _samples(self.corners, spacing)
        self._tree = KDTree(samples, balanced_tree=False, compact_nodes=False)

    def closest(
        self,
        points: Float[np.ndarray, "N 3"],
        candidates: int = _CANDIDATES,
        *,
        facing: Float[np.ndarray, "N 3"] | None = None,
        facing_mm: float = 10.0,
    ) -> Hits:
        """Closest surface point of each query point. With unit normals ``facing`` of the points, a triangle that faces
        the other way is chosen only where it is nearer by ``facing_mm``: lips that meet are told apart."""
        count = min(candidates, len(self._owner))
        nearest = self._tree.query(points, k=count, workers=-1)[1].reshape(len(points), count)
        triangles = self._owner[nearest]
        repeated = np.repeat(points, count, 0)
        found, weights = closest_on_triangles(repeated, self.corners[triangles.ravel()])
        distance = np.linalg.norm(repeated - found, axis=1).reshape(len(points), count)
        cost = distance
        if facing is not None:
            turned = np.einsum("nx,ncx->nc", facing, self.normals(triangles.ravel()).reshape(*triangles.shape, 3))
            cost = distance + 0.5 * facing_mm * (1.0 - turned)
        best = cost.argmin(1)
        row = np.arange(len(points))
        triangle = triangles[row, best]
        return Hits(
            found.reshape(len(points), count, 3)[row, best],
            triangle,
            weights.reshape(len(points), count, 3)[row, best],
            distance[row, best],
            self.normals(triangle),
        )

    def normals(self, triangles: Int[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
        """Unit normals of the given triangles."""
        corners = self.corners[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)


def _samples(
    corners: Float[np.ndarray, "F 3 3"], spacing: float
) -> tuple[Float[np.ndarray, "S 3"], Int[np.ndarray, " S"]]:
    """Points on the triangles and the triangle each lies on: the centroid, more where a triangle is large."""
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


def closest_on_triangles(
    points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N 3 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Closest point of each triangle to the point of the same row, and its barycentric weights."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (_dot(ab, ab), _dot(ab, ac), _dot(ac, ac))
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    scale = np.maximum(d00 * d11 - d01 * d01, 1e-18)
    v, w = (d11 * d20 - d01 * d21) / scale, (d00 * d21 - d01 * d20) / scale
    weights = np.stack([1 - v - w, v, w], 1)
    outside = np.flatnonzero((weights < 0).any(1))
    if len(outside):
        weights[outside] = _on_edges(points[outside], corners[outside])
    return np.einsum("nk,nkx->nx", weights, corners), weights


def _on_edges(points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3"]:
    best, weights = np.full(len(points), np.inf), np.zeros((len(points), 3))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, along = corners[:, i], corners[:, j] - corners[:, i]
        t = np.clip(_dot(points - start, along) / np.maximum(_dot(along, along), 1e-18), 0, 1)
        off = points - start - t[:, None] * along
        distance = _dot(off, off)
        better = distance < best
        best[better] = distance[better]
        weights[better] = 0
        weights[better, i], weights[better, j] = 1 - t[better], t[better]
    return weights


def _dot(a: Float[np.ndarray, "N 3"], b: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    return np.einsum("nx,nx->n", a, b)

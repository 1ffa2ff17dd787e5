"""Closest points of triangles by the plain formula, beside which the compiled search is tested."""

import numpy as np
from jaxtyping import Float, Int


def closest_candidates_naive(
    points: Float[np.ndarray, "n 3"],
    corners: Float[np.ndarray, "f 3 3"],
    facing: Float[np.ndarray, "n 3"] | None = None,
    facing_mm: float = 0.0,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Computes the same as ``closest_candidates`` with all triangles as candidates, by testing every pair."""
    triangle, weights = np.zeros(len(points), np.int64), np.zeros((len(points), 3))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
    for row, point in enumerate(points):
        found, blends = closest_on_triangles_naive(np.repeat(point[None], len(corners), 0), corners)
        cost = np.linalg.norm(found - point, axis=1)
        if facing is not None:
            cost = cost + 0.5 * facing_mm * (1.0 - normals @ facing[row])
        triangle[row] = cost.argmin()
        weights[row] = blends[triangle[row]]
    return triangle, weights


def closest_on_triangles_naive(
    points: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N 3 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Returns the closest point of each triangle to the point of the same row, and its barycentric weights: the foot of
    the perpendicular where it lies inside, else the best point of the three edges."""
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

"""Compiled loops of ``pipeline.geometry.normals``."""

import numpy as np

from pipeline.compute.jit import njit


@njit(cache=True, nogil=True, error_model="numpy")
def unit_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the unit normals (v, 3) of the vertices (v, 3), weighted by the area of the faces (f, 3)."""
    normals = np.zeros_like(vertices)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        px, py, pz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        qx, qy, qz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        x, y, z = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        for v in (a, b, c):
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z
    for v in range(len(normals)):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        if length == 0.0:
            normals[v, 2] = 1.0
        else:
            normals[v] /= length
    return normals


@njit(cache=True, nogil=True, error_model="numpy")
def cosines_towards(place: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the cosine between the unit normal (n, 3) of each of the points (n, 3) and the direction to a place."""
    cosine = np.empty(len(points))
    for n in range(len(points)):
        x, y, z = place[0] - points[n, 0], place[1] - points[n, 1], place[2] - points[n, 2]
        along = x * normals[n, 0] + y * normals[n, 1] + z * normals[n, 2]
        cosine[n] = along / np.sqrt(x * x + y * y + z * z)
    return cosine

"""Computes vertex normals in a compiled loop."""

import numpy as np

from rig.jit import njit


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

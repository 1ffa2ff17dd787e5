"""Defines triangle meshes and computes their normals and borders."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Holds vertices (mm) and triangles, whose corners are counter-clockwise seen from outside. ``colours`` holds the
    sRGB colour of each vertex."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colours: UInt8[np.ndarray, "v 3"] | None = None

    def normals(self) -> Float[np.ndarray, "v 3"]:
        """Computes unit vertex normals, weighted by the area of the faces; (0, 0, 1) where no face has an area."""
        return vertex_normals(self.vertices, self.faces)


def face_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Computes face normals. The length of each normal is twice the area of its face."""
    a, b, c = (vertices[faces[:, i]].T for i in range(3))
    (x, y, z), (u, v, w) = b - a, c - a
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def vertex_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Computes unit vertex normals, weighted by the area of the faces; (0, 0, 1) where no face has an area."""
    from rig.mesh_kernels import unit_normals  # compiled loops load for half a second, and many meshes need no normals

    normals = unit_normals(np.ascontiguousarray(vertices, np.float64), np.array(faces, np.int32, order="C"))
    return normals.astype(vertices.dtype, copy=False)


def boundary_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Returns the directed edges that belong to only one face, which form the border of an open mesh."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    low, high = edges.min(axis=1).astype(np.int64), edges.max(axis=1)
    # Both ends are packed into one number: sorting rows takes thirty times as long.
    _, first, count = np.unique((low << 32) | high, return_index=True, return_counts=True)
    return edges[first[count == 1]]


def edges_of(
    faces: Int[np.ndarray, "F 3"],
) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "F 3"], Int[np.ndarray, " E"]]:
    """Returns the mesh's edges as sorted pairs of vertices, and the number of triangles at each edge. Also returns, for
    each corner of each triangle, the index of the opposite edge."""
    directed = np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]]).astype(np.int64)
    low, high = directed.min(1), directed.max(1)
    base = int(faces.max()) + 1
    keys, inverse, counts = np.unique(low * base + high, return_inverse=True, return_counts=True)
    return (
        np.stack([keys // base, keys % base], 1).astype(np.int32),
        inverse.reshape(3, -1).T.astype(np.int32),
        counts.astype(np.int32),
    )

"""Compares a result with the true head of a simulated capture on disk.

<capture>.truth/  cameras.json  head.ply  face_mask.npy  colour_mask.npy  silhouettes/  head_silhouettes/  meta.json
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from rig.formats.meshes.mesh_file import read_mesh
from rig.mesh import Mesh, face_normals

NEAREST = 8  # vertices whose triangles are looked at; on an even mesh the nearest point lies on a triangle of the first


def error_mm(truth: Path, result: Path) -> dict[str, float]:
    """Computes the distance (mm) from the true face region to the surface of ``result`` as delivered, without aligning
    both. Returns mean, median and maximum, weighted by area."""
    head, face = read_mesh(truth / "head.ply"), np.load(truth / "face_mask.npy")
    distances = surface_distance(head.vertices[face], read_mesh(result))
    weights = _vertex_areas(head)[face]
    order = np.argsort(distances)
    share = np.cumsum(weights[order]) / weights.sum()
    return {
        "mean": float(np.average(distances, weights=weights)),
        "median": float(distances[order][np.searchsorted(share, 0.5)]),
        "max": float(distances.max()),
    }


def surface_distance(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> Float[np.ndarray, " n"]:
    """Computes the distance (mm) of each point to the nearest point on the triangles around the mesh's ``NEAREST``
    nearest vertices."""
    _, nearest = KDTree(mesh.vertices).query(points, k=NEAREST)
    first = np.searchsorted(np.sort(mesh.faces.ravel()), np.arange(len(mesh.vertices) + 1))
    of_vertex = np.argsort(mesh.faces.ravel(), kind="stable") // 3  # triangles, ordered by vertex
    best = np.full(len(points), np.inf)
    for column in np.asarray(nearest).T:
        count = first[column + 1] - first[column]
        for i in range(int(count.max())):
            has = count > i
            triangles = mesh.faces[of_vertex[first[column[has]] + i]]
            best[has] = np.minimum(best[has], _to_triangles(points[has], mesh.vertices, triangles))
    return best


def _to_triangles(
    p: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Returns the distance of point i to triangle i: to its plane if the foot lies inside, else to the nearest edge."""
    corners = vertices[triangles]
    edges = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edges[:, 0], -edges[:, 2])
    square = np.maximum((normal**2).sum(1), 1e-30)
    towards = p[:, None] - corners
    inside = (np.einsum("nij,nij->ni", np.cross(edges, towards), normal[:, None].repeat(3, 1)) >= 0).all(1)
    plane = np.abs((towards[:, 0] * normal).sum(1)) / np.sqrt(square)
    along = (towards * edges).sum(2) / np.maximum((edges**2).sum(2), 1e-30)
    to_edges = np.linalg.norm(towards - np.clip(along, 0, 1)[:, :, None] * edges, axis=2).min(1)
    return np.where(inside, plane, to_edges)


def _vertex_areas(mesh: Mesh) -> Float[np.ndarray, " v"]:
    areas = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1) / 2
    return np.bincount(mesh.faces.ravel(), np.repeat(areas / 3, 3), minlength=len(mesh.vertices))

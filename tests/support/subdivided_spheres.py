"""Spheres by subdivision, with the nodes of their displacements, and points of other surfaces."""

from functools import cache

import numpy as np
import scipy.sparse as sparse
import trimesh

from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.solve import Nodes, node_mesh
from pipeline.head_model.subdivision import row_count, subdivision
from pipeline.part_labels.codes import Part

RADIUS_MM = 80.0


@cache
def subdivided_sphere() -> tuple[np.ndarray, np.ndarray, Nodes]:
    """A sphere of 10,242 vertices (edges of 5 mm), its faces, and nodes on its cage and one step before it."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    cage = np.asarray(ball.faces, np.int32)
    first, middle = subdivision(cage, len(ball.vertices))
    second, faces = subdivision(middle, row_count(first))
    whole = sparse.csr_array(second @ first)
    vertices = whole @ np.asarray(ball.vertices)
    vertices *= RADIUS_MM / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, faces, Nodes(node_mesh(cage, whole), node_mesh(middle, second))


def ellipsoid_points(
    rng: np.random.Generator, semi_axes: np.ndarray, noise_mm: float, count: int = 40_000
) -> SurfacePoints:
    """Points of an ellipsoid about the origin with noise along its normals; all of skin."""
    unit = rng.standard_normal((count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normals = unit / semi_axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = unit * semi_axes + normals * rng.normal(0.0, noise_mm, (count, 1))
    return SurfacePoints(points, normals, np.full(count, max(noise_mm, 0.05)), np.full(count, Part.SKIN, np.uint8))


def ellipsoid_distance(points: np.ndarray, semi_axes: np.ndarray) -> np.ndarray:
    """Signed, mm, to first order: within 1e-3 of itself for ellipsoids that are nearly round."""
    level = np.linalg.norm(points / semi_axes, axis=1)
    return (level - 1.0) * level / np.linalg.norm(points / semi_axes**2, axis=1)

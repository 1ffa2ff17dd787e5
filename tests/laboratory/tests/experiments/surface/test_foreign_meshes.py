"""Foreign meshes made of a surface: every vertex on it, and edges elsewhere."""

import numpy as np
import trimesh

from pipeline.head_model.subdivision import check_manifold
from rig.mesh import boundary_edges
from tests.laboratory.experiments.surface.foreign_meshes import ForeignMesh, decimated_split, dual, shuffled

BALL = trimesh.creation.icosphere(subdivisions=4, radius=100.0)
VERTICES, FACES = np.array(BALL.vertices), np.array(BALL.faces, np.int32)
CAP = FACES[VERTICES[FACES].mean(axis=1)[:, 1] > -60.0]


def closed_triangles(mesh: ForeignMesh) -> np.ndarray:
    triangles = mesh.file(VERTICES).triangles()
    check_manifold(triangles)
    np.testing.assert_allclose(mesh.operator.sum(axis=1), 1.0)
    return triangles


def test_a_shuffled_mesh_is_the_surface() -> None:
    mesh = shuffled(FACES, np.arange(len(VERTICES)), len(VERTICES), 1)
    found = mesh.operator @ VERTICES
    triangles = closed_triangles(mesh)
    assert not np.allclose(found, VERTICES)
    volume = np.einsum("fx,fx->f", found[triangles[:, 0]], np.cross(found[triangles[:, 1]], found[triangles[:, 2]]))
    np.testing.assert_allclose(volume.sum() / 6.0, BALL.volume)


def test_the_dual_has_a_polygon_about_every_vertex_and_none_on_the_border() -> None:
    assert len(boundary_edges(closed_triangles(dual(FACES, len(VERTICES))))) == 0
    mesh = dual(CAP, len(VERTICES))
    border = np.unique(boundary_edges(CAP))
    assert len(mesh.polygons) == len(np.unique(CAP)) - len(border)
    assert {len(polygon) for polygon in mesh.polygons} == {5, 6}
    polygon = (mesh.operator @ VERTICES)[mesh.polygons[0]]
    assert np.cross(polygon[1] - polygon[0], polygon[2] - polygon[1]) @ polygon.mean(axis=0) > 0.0  # faces outwards


def test_a_decimated_split_lies_on_the_surface_with_other_edges() -> None:
    mesh = decimated_split(VERTICES, FACES, 4000)
    assert len(boundary_edges(closed_triangles(mesh))) == 0
    assert len(mesh.polygons) == 4000
    entries = np.diff(mesh.operator.indptr)
    assert set(entries) <= {1, 2}
    radius = np.linalg.norm(mesh.operator @ VERTICES, axis=1)
    assert 99.0 < radius.min() < radius.max() < 100.01

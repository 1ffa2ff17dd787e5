"""Meshes that cross themselves or touch are moved apart, and nothing else is."""

import numpy as np
import trimesh

from pipeline.fusion.crossings import crossing_faces, separate_coincidences
from rig.mesh import Mesh


def two_touching_balls() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    top = vertices[:, 2].argmax()
    other = -vertices + 2.0 * vertices[top]
    joined = np.concatenate([faces, faces[:, ::-1] + len(vertices)]).astype(np.int32)
    return Mesh(np.concatenate([vertices, other]), joined)


def test_sheets_that_touch_are_moved_apart() -> None:
    mesh = two_touching_balls()
    apart = separate_coincidences(mesh)
    moved = np.linalg.norm(apart.vertices - mesh.vertices, axis=1)
    assert (moved > 0.0).sum() == 2
    assert moved.max() < 0.1
    assert len(np.unique(apart.vertices.astype(np.float32), axis=0)) == len(apart.vertices)
    assert not crossing_faces(apart.vertices, apart.faces).any()
    assert trimesh.Trimesh(apart.vertices, apart.faces, process=True).is_watertight


def test_a_mesh_without_coincidences_stays() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32))
    assert separate_coincidences(mesh) is mesh

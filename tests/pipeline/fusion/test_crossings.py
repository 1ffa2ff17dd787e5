"""Meshes that cross themselves or touch are moved apart, and nothing else is."""

import numpy as np
import trimesh

from pipeline.fusion.crossings import crossing_faces, without_coincidences, without_crossings
from rig.mesh import Mesh


def two_touching_balls() -> Mesh:
    """Their nearest vertices lie at one place."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    top = vertices[:, 2].argmax()
    other = -vertices + 2.0 * vertices[top]
    joined = np.concatenate([faces, faces[:, ::-1] + len(vertices)]).astype(np.int32)
    return Mesh(np.concatenate([vertices, other]), joined)


def is_closed_when_merged(mesh: Mesh) -> bool:
    return bool(trimesh.Trimesh(mesh.vertices, mesh.faces, process=True).is_watertight)


def test_sheets_that_touch_are_moved_apart() -> None:
    mesh = two_touching_balls()
    apart = without_coincidences(mesh)
    moved = np.linalg.norm(apart.vertices - mesh.vertices, axis=1)
    assert (moved > 0.0).sum() == 2
    assert moved.max() < 0.1
    assert len(np.unique(apart.vertices.astype(np.float32), axis=0)) == len(apart.vertices)
    assert not crossing_faces(apart.vertices, apart.faces).any()
    assert is_closed_when_merged(apart)


def test_a_mesh_without_coincidences_stays() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32))
    assert without_coincidences(mesh) is mesh


def ball(radius_mm: float = 50.0) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius_mm)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces, np.int32))


def test_a_crumpled_patch_is_smoothed_where_it_lies() -> None:
    """Safe positions 5 mm deeper would leave a pit."""
    smooth = ball()
    crumpled = smooth.vertices.copy()
    near = smooth.vertices[:, 2] > 47.0
    aside = np.random.default_rng(0).normal(0.0, 2.5, (int(near.sum()), 3))
    crumpled[near] += aside
    crumpled *= 50.0 / np.linalg.norm(crumpled, axis=1, keepdims=True)  # aside and not out
    mesh = Mesh(crumpled, smooth.faces)
    assert crossing_faces(crumpled, smooth.faces).any()
    apart, moved = without_crossings(mesh, 0.9 * smooth.vertices)
    assert 0 < moved < 3 * near.sum()
    assert not crossing_faces(apart.vertices, apart.faces).any()
    assert np.linalg.norm(apart.vertices, axis=1).min() > 49.0
    assert (apart.vertices[smooth.vertices[:, 2] < 30.0] == crumpled[smooth.vertices[:, 2] < 30.0]).all()


def test_sheets_that_pass_through_each_other_go_back_to_where_they_were_safe() -> None:
    """No smoothing parts two balls."""
    one = ball()
    safe = np.concatenate([one.vertices, one.vertices + (0.0, 0.0, 101.0)])
    mesh = Mesh(
        np.concatenate([one.vertices, one.vertices + (0.0, 0.0, 90.0)]),
        np.concatenate([one.faces, one.faces + len(one.vertices)]),
    )
    apart, _ = without_crossings(mesh, safe)
    assert not crossing_faces(apart.vertices, apart.faces).any()

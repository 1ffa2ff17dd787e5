"""Pieces of the registration on small meshes, and a whole one."""

import numpy as np
import pytest
import trimesh

from pipeline.applications.templates.placement import Surface, find_place, outward, place_by_landmarks
from pipeline.applications.templates.registration import (
    NotRegistered,
    balls,
    components,
    register,
    skin_parts,
    weld,
    without_edge,
    without_specks,
)
from pipeline.head_model.model import load_model
from rig.errors import InputError
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.geometry import rotation_from_vector
from rig.progress import discard_progress


def surface(*meshes: trimesh.Trimesh) -> Surface:
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]).astype(np.int32)
    return Surface.of(vertices, faces)


def polygons(vertices: np.ndarray, faces: np.ndarray) -> PolygonMesh:
    none = np.full(faces.size, -1, np.int32)
    sizes = np.full(len(faces), 3, np.int32)
    return PolygonMesh(vertices, sizes, faces.ravel().astype(np.int32), np.zeros((0, 2)), none)


def test_a_torn_surface_is_sewn_up_and_what_only_touches_it_is_not() -> None:
    grid = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    torn = surface(trimesh.Trimesh(grid.vertices[grid.faces.ravel()], np.arange(grid.faces.size).reshape(-1, 3)))
    whole, joined = weld(torn)
    assert len(whole.vertices) == len(grid.vertices)
    np.testing.assert_array_equal(whole.vertices[joined], torn.vertices)
    lash = trimesh.Trimesh([grid.vertices[0], [20, 0, 0], [20, 1, 0]], [[0, 1, 2]], process=False)
    touching, _ = weld(surface(grid, lash))
    assert components(touching).max() == 1


def test_round_closed_parts_move_as_wholes() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=12.0)
    tooth = trimesh.creation.box(extents=(4.0, 12.0, 3.0))
    half = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0], process=False)
    mesh = surface(ball, tooth, half)
    parts = components(mesh)
    found = balls(mesh, parts, np.ones(parts.max() + 1, bool))
    assert set(found[: len(ball.vertices)]) == {0}
    assert set(found[len(ball.vertices) :]) == {-1}


def test_skin_is_what_the_head_meets_first() -> None:
    outer, inner = (trimesh.creation.icosphere(subdivisions=3, radius=radius) for radius in (100.0, 20.0))
    mesh = surface(outer, inner)
    parts = components(mesh)
    head = surface(trimesh.creation.icosphere(subdivisions=3, radius=103.0))
    assert skin_parts(mesh, parts, head)[parts[[0, -1]]].tolist() == [True, False]


def test_specks_go_and_edges_are_drawn_back() -> None:
    ball = surface(trimesh.creation.icosphere(subdivisions=4, radius=10.0))
    mask = ball.vertices[:, 2] > 0
    speck = int(ball.vertices[:, 2].argmin())
    mask[speck] = True
    kept = without_specks(mask, ball.faces)
    assert not kept[speck]
    assert kept.sum() == mask.sum() - 1
    less = without_edge(kept, ball.faces)
    edge_mm = 10.0 * 1.2 / 2**4  # of the ball's triangles
    assert less[ball.vertices[:, 2] > 4 * edge_mm].all()
    assert not less[ball.vertices[:, 2] < 0.5 * edge_mm].any()


def test_faces_that_look_inwards_are_turned_over() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    found = outward(np.array(ball.vertices), np.array(ball.faces[:, ::-1], np.int32))
    assert (np.einsum("nx,nx->n", found.normals, found.vertices) > 0).all()


def test_landmarks_place_a_mesh_in_any_unit_and_too_few_are_refused() -> None:
    model = load_model()
    mean, turn = model.vertices(np.zeros(0)), rotation_from_vector(np.array([0.3, 2.0, -0.4]))
    theirs = 0.01 * mean @ turn.T + (4.0, 5.0, 6.0)
    marks = {name: theirs[row] for name, row in model.landmarks.items()}
    np.testing.assert_allclose(place_by_landmarks(model, marks, "head").apply(theirs), mean, atol=1e-6)
    with pytest.raises(InputError, match="3 landmarks are known, 4 are needed"):
        place_by_landmarks(model, dict(list(marks.items())[:3]), "head")
    line = {name: np.array([k, 0.0, 0.0]) for k, name in enumerate(list(marks)[:5])}
    with pytest.raises(InputError, match="line"):
        place_by_landmarks(model, line, "head")


def test_what_is_no_head_in_any_unit_is_refused() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=40.0)
    with pytest.raises(InputError, match="too little for a head in mm, cm, dm, m"):
        find_place(load_model(), surface(ball), "ball.obj")


@pytest.mark.slow
def test_a_mesh_in_another_order_unit_and_frame_lies_on_the_model_again() -> None:
    """The model's own 5 % level as a foreign mesh: its vertices are vertices of the full level."""
    model = load_model()
    level, rng = model.levels["p95"], np.random.default_rng(3)
    order = rng.permutation(level.count)
    shape = model.vertices(np.zeros(0), "p95")[order][:, [2, 0, 1]] / 10.0 + 7.0
    mesh = polygons(shape, np.argsort(order)[level.faces])
    found = register(mesh, model, name="level.obj", report=discard_progress)
    head = model.vertices(rng.standard_normal(len(model.modes)))
    off = np.linalg.norm(found.surface_binding.on(head, model.levels["full"].faces) - head[level.rows[order]], axis=1)
    # chords of 9 mm sag by 0.1 mm on a head, and the model is made like the chords
    assert np.median(off) < 0.15
    assert found.covered > 0.95
    ball = trimesh.creation.icosphere(subdivisions=4, radius=100.0)
    round_one = polygons(np.array(ball.vertices), np.array(ball.faces))
    with pytest.raises(NotRegistered, match="farther than any head"):
        register(round_one, model, name="ball.obj", report=discard_progress)

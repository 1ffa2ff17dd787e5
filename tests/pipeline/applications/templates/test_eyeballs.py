"""Eyeballs that are added to a mesh with open eyes."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.util import wrap_as_stream

from pipeline.applications.templates.animated import AnimatedMesh
from pipeline.applications.templates.eyeballs import Eyeball, lift_lids, place_eyeballs, turn_to
from pipeline.applications.templates.write.writers import animated_scene
from pipeline.fusion.crossings import crossing_faces
from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.polygon_obj import scene_obj_bytes
from rig.formats.meshes.scene import Part, Scene
from rig.formats.meshes.usdz import scene_usdz_bytes
from rig.geometry import rotation_from_vector
from rig.mesh import Mesh, boundary_edges, vertex_normals
from rig.studio.scene.anatomy import grid_faces
from tests.support.glb import opened_glb

AHEAD = np.array([0.0, 0.0, 1.0])
CENTRES = {"eye_left": np.array([30.0, 10.0, 60.0]), "eye_right": np.array([-30.0, 10.0, 60.0])}
LID_MM = 12.5  # of the lids' own ball


def lids(*, slit: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """The lids of the left eye, part of a ball a little larger than an eyeball: vertices, triangles, the upper lid's
    way down (each vertex to where it is turned to), and the corners of both eyes."""
    x, y = np.meshgrid(np.linspace(-11, 11, 45), np.linspace(-9, 9, 37))
    flat = np.stack([x, y, np.sqrt(np.maximum(LID_MM**2 - x**2 - y**2, 4.0))], axis=2).reshape(-1, 3)
    faces = grid_faces(*x.shape, closed=False)[:, ::-1]
    middle = flat[faces].mean(axis=1)
    opening = (middle[:, 0] / 9.5) ** 2 + (middle[:, 1] / 4.5) ** 2 < 1.0
    upper = np.clip((flat[:, 1] + 0.1) / 4.0, 0.0, 1.0) * (1.0 - (flat[:, 0] / 11.5) ** 2) * (flat[:, 1] > 0)
    turned = [rotation_from_vector(np.array([0.6 * share, 0.0, 0.0])) @ v for share, v in zip(upper, flat, strict=True)]
    corners = {"exocanthion_left": (39.5, 10, 68), "endocanthion_left": (20.5, 10, 68)}
    corners |= {"exocanthion_right": (-39.5, 10, 68), "endocanthion_right": (-20.5, 10, 68)}
    marks = {name: np.array(place, float) for name, place in corners.items()}
    return flat + CENTRES["eye_left"], faces[~opening] if slit else faces, np.array(turned) - flat, marks


def crossing(vertices: np.ndarray, faces: np.ndarray, eyeball: Eyeball) -> int:
    ball = eyeball.mesh()
    joined = np.concatenate([vertices, ball.vertices]), np.concatenate([faces, ball.faces + len(vertices)])
    return int(crossing_faces(*joined)[len(faces) :].sum())


@pytest.mark.parametrize("gaze", [(0.0, 0.0, 1.0), (0.3, -0.2, 0.9)])
def test_an_eyeball_is_closed_and_has_a_cornea_where_it_looks(gaze: tuple[float, float, float]) -> None:
    towards = np.array(gaze) / np.linalg.norm(gaze)
    ball = Eyeball(np.array([31.0, 12.0, 60.0]), towards)
    mesh = ball.mesh()
    assert not len(boundary_edges(mesh.faces))
    assert not crossing_faces(mesh.vertices, mesh.faces).any()
    away = mesh.vertices - ball.centre
    assert (np.einsum("nx,nx->n", vertex_normals(mesh.vertices, mesh.faces), away) > 0).all()
    assert np.linalg.norm(away, axis=1).min() == pytest.approx(12.0, abs=1e-9)
    apex = away[np.linalg.norm(away, axis=1).argmax()]
    np.testing.assert_allclose(apex, 13.15 * towards, atol=0.01)  # the ball's own front lies at 12
    volume = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 12.0**3, rel=0.03)
    assert mesh.colours is not None
    dark = mesh.vertices[(np.asarray(mesh.colours) < 30).all(axis=1)]
    np.testing.assert_allclose(dark.mean(axis=0), ball.centre + 13.0 * towards, atol=0.2)


def test_a_ball_lies_right_behind_open_lids_and_where_an_eye_is_closed_there_is_none() -> None:
    vertices, faces, _, marks = lids(slit=True)
    found = place_eyeballs(vertices, faces, marks, CENTRES)
    assert set(found) == {"eye_left"}
    eyeball = found["eye_left"]
    np.testing.assert_allclose(eyeball.centre[:2], CENTRES["eye_left"][:2])
    assert CENTRES["eye_left"][2] - 3.0 < eyeball.centre[2] <= CENTRES["eye_left"][2]
    assert crossing(vertices, faces, eyeball) == 0
    ahead = Eyeball(eyeball.centre + (0.0, 0.0, 0.6), AHEAD)
    assert crossing(vertices, faces, ahead) > 0
    closed, whole, _, _ = lids(slit=False)
    assert place_eyeballs(closed, whole, marks, CENTRES) == {}


@pytest.mark.parametrize("gaze", [(0.0, 0.0), (0.26, 0.0), (-0.26, 0.0), (0.0, 0.26), (0.0, -0.26)])
def test_a_lid_closes_over_the_ball_without_crossing_it(gaze: tuple[float, float]) -> None:
    vertices, faces, down, marks = lids(slit=True)
    towards = np.array([*gaze, np.sqrt(1.0 - np.square(gaze).sum())])
    eyes = place_eyeballs(vertices, faces, marks, CENTRES, {"eye_left": towards})
    eyeball = eyes["eye_left"]
    assert any(gaze) or crossing(vertices + 0.5 * down, faces, eyeball) > 0  # a cornea below the slit lies deeper
    free = lift_lids(vertices, faces, down, eyes)
    for weight in (0.0, 0.5, 1.0):
        assert crossing(vertices + weight * free, faces, eyeball) == 0
    still = np.linalg.norm(down, axis=1) < 1e-9
    assert not (free - down)[still].any()
    assert np.linalg.norm(free - down, axis=1).max() < 3.0
    np.testing.assert_array_equal(lift_lids(vertices, faces, np.zeros_like(down), eyes), 0.0)


def test_an_added_eyeball_is_a_part_that_turns_about_its_centre_to_where_the_eye_looks() -> None:
    vertices, faces, down, marks = lids(slit=True)
    gaze = np.array([0.25, -0.1, 0.96]) / np.linalg.norm([0.25, -0.1, 0.96])
    eyes = place_eyeballs(vertices, faces, marks, CENTRES, {"eye_left": gaze})
    assert crossing(vertices, faces, eyes["eye_left"]) == 0
    points = {name: eyeball.centre for name, eyeball in eyes.items()} | {"neck": np.zeros(3)}
    animated = AnimatedMesh(vertices, {"eyeBlinkLeft": down}, points, {}, eyes, gazes={"eye_left": gaze})
    colours, triangles = np.full(vertices.shape, 200, np.uint8), faces.astype(np.int32)
    parts = animated_scene(animated, triangles, colours, {"eyeBlinkLeft": 0.0})
    glb = scene_glb_bytes(parts)
    scene = trimesh.load_scene(wrap_as_stream(glb), file_type="glb")
    place, geometry = scene.graph["eye_left"]
    there = 1000.0 * trimesh.transform_points(scene.geometry[geometry].vertices, place) - eyes["eye_left"].centre
    np.testing.assert_allclose(there[np.linalg.norm(there, axis=1).argmax()], 13.15 * gaze, atol=0.02)
    document, _ = opened_glb(glb)
    turned = next(node for node in document["nodes"] if node["name"] == "eye_left")
    np.testing.assert_allclose(turned["translation"], eyes["eye_left"].centre / 1000.0, atol=1e-9)
    assert "extras" not in turned
    _, _, z, w = turned["rotation"]
    assert 2.0 * np.arccos(w) == pytest.approx(np.arccos(gaze[2]), abs=1e-6)
    assert z == pytest.approx(0.0, abs=1e-9)  # no roll
    # The same by name in OBJ and USD.
    text = scene_obj_bytes(parts).decode().splitlines()
    assert [line for line in text if line.startswith("o ")] == ["o head", "o eye_left"]
    points_mm = np.array([line.split()[1:4] for line in text if line.startswith("v ")], float)
    ball = points_mm[len(vertices) :] - eyes["eye_left"].centre
    np.testing.assert_allclose(ball[np.linalg.norm(ball, axis=1).argmax()], 13.15 * gaze, atol=0.02)
    corners = np.array([line.split()[1:] for line in text if line.startswith("f ")], int)
    assert corners.min() == 1
    assert corners.max() == len(points_mm)


def test_parts_of_a_usdz_have_names_and_turn(tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    geom = pytest.importorskip("pxr.UsdGeom")
    eyeball = Eyeball(np.zeros(3), AHEAD)
    gaze = np.array([0.6, 0.0, 0.8])
    ball = eyeball.mesh()
    part = Part("eye_left", Mesh(ball.vertices + CENTRES["eye_left"], ball.faces, ball.colours), pivot="eye_left")
    scene = Scene([part], CENTRES, {"eye_left": turn_to(gaze)})
    path = tmp_path / "head-parts.usdz"
    path.write_bytes(scene_usdz_bytes(scene))
    assert path.read_bytes() == scene_usdz_bytes(scene)
    stage = usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/person/eye_left")
    points = np.array(geom.Mesh(prim).GetPointsAttr().Get(), float)
    matrix = np.array(geom.XformCache().GetLocalToWorldTransform(prim))  # rows: points are rows, too
    there = 1000.0 * (points @ matrix[:3, :3] + matrix[3, :3]) - CENTRES["eye_left"]
    np.testing.assert_allclose(there[np.linalg.norm(there, axis=1).argmax()], 13.15 * gaze, atol=0.02)

"""Teeth and a tongue that are added to a mesh whose lips part."""

import numpy as np
import pytest

from pipeline.applications.templates.animated import AnimatedMesh
from pipeline.applications.templates.inner_mouth import (
    InnerMouth,
    keep_off_teeth,
    load_inner_mouth,
    meeting_triangles,
    place_inner_mouth,
)
from pipeline.applications.templates.pivots import hinge, jaw_motions
from pipeline.applications.templates.write.writers import animated_scene
from pipeline.fusion.crossings import crossing_faces
from pipeline.head_model.model import HeadModel
from rig.formats.meshes.glb import scene_glb_bytes
from rig.mesh import boundary_edges
from tests.support.glb import opened_glb
from tests.support.ready_templates import parted_faces


def skin_of(model: HeadModel, mean: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The 5 % level and how an open jaw moves it."""
    level = model.levels["p95"]
    return mean[level.rows], {"jawOpen": level.operator @ model.expressions.moved({"jawOpen": 1.0})}


def placed(
    model: HeadModel,
    mean: np.ndarray,
    marks: dict[str, np.ndarray],
    faces: np.ndarray,
    *,
    more: np.ndarray | None = None,
    joined: bool = False,
) -> InnerMouth:
    """The parts of that level; ``more`` are vertices, of a part of their own or joined, which no shape moves."""
    skin, shapes = skin_of(model, mean)
    loose = np.full(len(skin), -1)
    if more is not None:
        skin, loose = np.concatenate([skin, more]), np.append(loose, np.full(len(more), -1 if joined else 0))
        shapes = {name: np.concatenate([shape, np.zeros_like(more)]) for name, shape in shapes.items()}
    full = {"jawOpen": model.levels["full"].operator @ model.expressions.moved({"jawOpen": 1.0})}
    return place_inner_mouth(skin, faces, shapes, marks, jaw_motions(marks, mean, full), loose)


@pytest.fixture(scope="module")
def inner(model: HeadModel, mean: np.ndarray, points: dict[str, np.ndarray]) -> InnerMouth:
    return placed(model, mean, points, parted_faces(model))


def test_the_shipped_parts_are_closed_and_cross_neither_themselves_nor_each_other() -> None:
    parts, anchors = load_inner_mouth()
    assert list(parts) == ["teeth_upper", "teeth_lower", "tongue"]
    vertices, faces = [], []
    for part in parts.values():
        assert not len(boundary_edges(part.mesh.faces))
        a, b, c = np.moveaxis(part.mesh.vertices[part.mesh.faces], 1, 0)
        assert np.einsum("fx,fx->", np.cross(a, b), c) > 0.0  # normals leave it
        faces.append(part.mesh.faces + sum(map(len, vertices)))
        vertices.append(part.mesh.vertices)
    assert not crossing_faces(np.concatenate(vertices), np.concatenate(faces)).any()
    upper, stomion = parts["teeth_upper"].mesh.vertices, anchors["stomion"]
    assert upper[:, 1].min() == pytest.approx(stomion[1] - 2.5, abs=0.3)
    assert 5.0 < stomion[2] - upper[:, 2].max() < 15.0
    out = parts["tongue"].tongue_out
    assert out[:, 2].max() > 25.0
    behind = np.argsort(parts["tongue"].mesh.vertices[:, 2])
    assert np.linalg.norm(out[behind[:50]], axis=1).mean() < 0.5 * np.linalg.norm(out[behind[-50:]], axis=1).mean()


def test_upper_teeth_stay_and_lower_ones_turn_about_the_hinge(inner: InnerMouth, points: dict[str, np.ndarray]) -> None:
    assert inner.absence is None
    assert inner.moves["teeth_upper"] == {}
    assert "tongueOut" in inner.moves["tongue"]
    assert "viseme_aa" in inner.moves["teeth_lower"]
    rest = inner.parts["teeth_lower"].vertices
    opened = inner.posed("jawOpen", 1.0)["teeth_lower"]
    axis = hinge(points)[1:]
    before, after = (np.linalg.norm(points[:, 1:] - axis, axis=1) for points in (rest, opened))
    np.testing.assert_allclose(after, before, atol=1e-6)
    assert (rest[:, 1] - opened[:, 1]).max() > 10.0
    np.testing.assert_allclose(
        inner.moves["teeth_lower"]["viseme_aa"], 0.6 * inner.moves["teeth_lower"]["jawOpen"], atol=1e-9
    )


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_an_open_mouth_meets_no_part(model: HeadModel, mean: np.ndarray, inner: InnerMouth, weight: float) -> None:
    skin, shapes = skin_of(model, mean)
    posed = skin + weight * shapes["jawOpen"]
    assert not meeting_triangles(posed, parted_faces(model), inner.posed("jawOpen", weight), inner).any()
    ahead = {name: points + (0.0, 0.0, 15.0) for name, points in inner.posed("jawOpen", weight).items()}
    assert meeting_triangles(posed, parted_faces(model), ahead, inner).any()


def test_nothing_is_added_without_room(model: HeadModel, mean: np.ndarray, points: dict[str, np.ndarray]) -> None:
    faces, count = parted_faces(model), model.levels["p95"].count
    assert placed(model, mean, points, np.asarray(model.levels["p95"].faces)).absence == "mouth-sealed"
    middle = points["stomion"]
    teeth = middle + np.array([[-20.0, 3.0, -25.0], [20.0, 3.0, -25.0], [0.0, 3.0, -12.0]])
    beside = placed(model, mean, points, np.append(faces, [[count, count + 1, count + 2]], axis=0), more=teeth)
    assert (beside.absence, beside.parts) == ("own-parts", {})
    wall = middle + np.array([[-15.0, -9.0, -28.0], [15.0, -9.0, -28.0], [0.0, 15.0, -28.0]])
    none = placed(
        model, mean, points, np.append(faces, [[count, count + 1, count + 2]], axis=0), more=wall, joined=True
    )
    assert none.absence == "no-room"


def test_lips_that_are_pressed_in_keep_off_the_teeth(
    model: HeadModel, mean: np.ndarray, inner: InnerMouth, points: dict[str, np.ndarray]
) -> None:
    skin, shapes = skin_of(model, mean)
    faces = parted_faces(model)
    away = ((skin - points["labiale_inferius"]) ** 2).sum(axis=1)
    shapes["mouthPressLeft"] = np.exp(-0.5 * away / 10.0**2)[:, None] * np.array([0.0, 0.0, -18.0])
    shapes["browInnerUp"] = np.zeros_like(skin)
    name = "mouthPressLeft"
    before = meeting_triangles(skin + shapes[name], faces, inner.posed(name, 1.0), inner)
    assert before.any()
    free = keep_off_teeth(skin, faces, shapes, inner)
    for weight in (0.5, 1.0):
        assert not meeting_triangles(skin + weight * free[name], faces, inner.posed(name, weight), inner).any()
    assert free["browInnerUp"] is shapes["browInnerUp"]
    far = np.sqrt(away) > 40.0
    np.testing.assert_allclose(free[name][far], shapes[name][far], atol=1e-6)
    assert (free[name][:, 2] <= 1.0).all()  # no lip is thrown outwards


def test_the_parts_are_nodes_under_what_they_move_with(
    model: HeadModel, mean: np.ndarray, inner: InnerMouth, points: dict[str, np.ndarray]
) -> None:
    skin, shapes = skin_of(model, mean)
    pivots = {"jaw": hinge(points), "neck": np.array([0.0, -26.0, -11.0])}
    animated = AnimatedMesh(skin, shapes, pivots, {}, {}, inner)
    colours = np.full(skin.shape, 200, np.uint8)
    scene = animated_scene(animated, parted_faces(model), colours, {"jawOpen": 0.25})
    document, _ = opened_glb(scene_glb_bytes(scene))
    nodes = {node["name"]: node for node in document["nodes"]}
    below = {name: {document["nodes"][k]["name"] for k in nodes[name]["children"]} for name in ("neck", "jaw")}
    assert below == {"neck": {"head", "jaw", "teeth_upper"}, "jaw": {"teeth_lower", "tongue"}}
    meshes = {mesh["name"]: mesh for mesh in document["meshes"]}
    assert "targets" not in meshes["teeth_upper"]["primitives"][0]
    targets = meshes["tongue"]["extras"]["targetNames"]
    assert {"jawOpen", "tongueOut"} <= set(targets)
    assert meshes["tongue"]["weights"][targets.index("jawOpen")] == 0.25
    np.testing.assert_allclose(nodes["teeth_upper"]["translation"], -pivots["neck"] / 1000.0)
    for name, pivot in (("teeth_upper", np.zeros(3)), ("teeth_lower", pivots["jaw"])):
        position = document["accessors"][meshes[name]["primitives"][0]["attributes"]["POSITION"]]
        highest = (inner.parts[name].vertices - pivot).max(axis=0) / 1000.0
        np.testing.assert_allclose(position["max"], highest, atol=1e-6)

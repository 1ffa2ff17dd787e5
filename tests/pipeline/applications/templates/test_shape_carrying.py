"""Shapes on meshes with insides: lips that touch, lashes, eyeballs, teeth."""

import itertools

import numpy as np
import pytest
import trimesh

from pipeline.applications.templates.carrying import SurfaceBinding, bind_vertices, surface_binding
from pipeline.applications.templates.shape_carrying import Neutral, carried_shapes
from pipeline.head_model.model import HeadModel
from rig.mesh import vertex_normals

NAMES = ("jawOpen", "eyeBlinkLeft", "mouthUpperUpLeft", "mouthFunnel")


@pytest.fixture(scope="module")
def mean(model: HeadModel) -> np.ndarray:
    return model.vertices(np.zeros(0))


def moves(model: HeadModel) -> dict[str, np.ndarray]:
    return {name: model.levels["full"].operator @ model.expressions.moved({name: 1.0}) for name in NAMES}


def points_of(model: HeadModel, mean: np.ndarray) -> dict[str, np.ndarray]:
    return {name: mean[row] for name, row in model.landmarks.items()}


def coarse(model: HeadModel, mean: np.ndarray, *parts: trimesh.Trimesh) -> tuple[SurfaceBinding, np.ndarray]:
    """The model's 5 % level, skin but for what lies about the mouth's slit, and parts of their own; the first of them
    moves as a whole."""
    level = model.levels["p95"]
    skin = mean[level.rows]
    out = np.linalg.norm(skin - mean[model.landmarks["stomion"]], axis=1) > 14.0
    rest = np.concatenate([skin, *(np.array(part.vertices) for part in parts)])
    starts = len(skin) + np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [level.faces, *(np.array(part.faces) + start for part, start in zip(parts, starts, strict=False))]
    triangles = np.concatenate(faces).astype(np.int32)
    wholes = np.full(len(rest), -1)
    if parts:
        wholes[len(skin) : starts[1]] = 0
    rows = np.flatnonzero(out)
    normals = vertex_normals(skin, level.faces)[rows]
    attachment, _, _ = bind_vertices(skin[rows], normals, mean, model.levels["full"].faces)
    return surface_binding(rest, rows, attachment, wholes), triangles


def carried(
    model: HeadModel, mean: np.ndarray, binding: SurfaceBinding, triangles: np.ndarray
) -> dict[str, np.ndarray]:
    neutral = Neutral(mean, model.levels["full"].faces, binding.on(mean, model.levels["full"].faces))
    return carried_shapes(binding, triangles, neutral, moves(model), points_of(model, mean))


def test_the_insides_of_lips_move_with_their_own_lip(model: HeadModel, mean: np.ndarray) -> None:
    binding, triangles = coarse(model, mean)
    found, rows = carried(model, mean, binding, triangles), model.levels["p95"].rows
    for name, shape in moves(model).items():
        true = shape[rows]
        error = np.linalg.norm(found[name] - true) / np.linalg.norm(true)
        smooth = binding.on(mean + shape, model.levels["full"].faces) - binding.on(mean, model.levels["full"].faces)
        assert error < 0.05, name
        if name != "eyeBlinkLeft":
            assert np.linalg.norm(smooth - true) / np.linalg.norm(true) > 2.0 * error, name


def test_eyeballs_stay_teeth_go_with_the_jaw_and_lashes_with_the_lid(model: HeadModel, mean: np.ndarray) -> None:
    shapes, points = moves(model), points_of(model, mean)
    lid = int(np.linalg.norm(shapes["eyeBlinkLeft"], axis=1).argmax())
    edge = mean[lid]
    eye = trimesh.creation.icosphere(subdivisions=2, radius=12.0)
    eye.apply_translation((31.0, 12.0, 62.0))
    lower, upper = (trimesh.creation.box(extents=(20.0, 6.0, 4.0)) for _ in range(2))
    lower.apply_translation(points["stomion"] + (0.0, -5.0, -22.0))
    upper.apply_translation(points["stomion"] + (0.0, 5.0, -22.0))
    tip = np.array([edge + (0, 0, 1.0), edge + (0.5, 0, 1.0), edge + (0.2, 1.0, 9.0)])
    lash = trimesh.Trimesh(tip, [[0, 1, 2]], process=False)
    binding, triangles = coarse(model, mean, eye, lower, upper, lash)
    found = carried(model, mean, binding, triangles)
    first = len(model.levels["p95"].rows)
    ends = first + np.cumsum([0, len(eye.vertices), len(lower.vertices), len(upper.vertices), 3])
    eyes, below, above, lashes = (slice(a, b) for a, b in itertools.pairwise(ends))
    assert not any(np.abs(found[name][eyes]).max() for name in NAMES)
    assert not any(np.abs(found[name][above]).max() for name in NAMES)
    before, after = binding.rest[below], binding.rest[below] + found["jawOpen"][below]
    assert found["jawOpen"][below][:, 1].max() < -5.0
    np.testing.assert_allclose(np.ptp(after, axis=0)[0], np.ptp(before, axis=0)[0], atol=1e-6)  # it stays a tooth
    assert np.abs(found["eyeBlinkLeft"][below]).max() == 0.0
    closing = found["eyeBlinkLeft"][lashes]
    assert closing[:2, 1].max() < -5.0  # its roots go down with the lid's edge
    length = np.linalg.norm(binding.rest[lashes][2] + closing[2] - binding.rest[lashes][0] - closing[0])
    assert abs(length - np.linalg.norm(tip[2] - tip[0])) < 0.5

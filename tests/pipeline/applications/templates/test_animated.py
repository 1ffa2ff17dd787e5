"""Shapes of a mesh: of one with insides, a mouth that closes after it has opened, lips nearly shut, visemes."""

import itertools

import numpy as np
import pytest
import trimesh
from jaxtyping import Float, Int

from pipeline.applications.templates.animated import PRESS_MM, Neutral, carried_shapes, parted_shapes, shut_lips
from pipeline.applications.templates.carrying import SurfaceBinding, bind_vertices, surface_binding
from pipeline.applications.templates.contact import WEIGHTS, crossing_vertices, prepare_rest_surface
from pipeline.applications.templates.eyeballs import AHEAD, Eyeball
from pipeline.applications.templates.write.writers import (
    SIZE_PX,
    PhotographedEyes,
    darkest_direction,
    eyeball_uv,
    paint_eyeball,
)
from pipeline.geometry.projection import depth_map
from pipeline.head_model.expressions import VISEMES, mixed
from pipeline.head_model.model import HeadModel, load_model
from pipeline.head_model.subdivision import opened_faces
from pipeline.texturing.layout.uv_unwrap import Atlas, Layout
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at
from rig.mesh import Mesh, vertex_normals
from rig.studio.scene.anatomy import grid_faces
from tests.pipeline.applications.templates.conftest import moves
from tests.pipeline.applications.templates.test_contact import EVERY, dent, sheets

NAMES = ("jawOpen", "eyeBlinkLeft", "mouthUpperUpLeft", "mouthFunnel")


def test_a_mouth_closes_after_it_has_opened_and_speaks_without_crossing() -> None:
    vertices, faces = sheets(gap_mm=0.3)
    rest, upper = prepare_rest_surface(vertices, faces), np.arange(len(vertices)) >= len(vertices) // 2
    opening = np.where(upper, 0.0, -8.0)[:, None] * (0.0, 0.0, 1.0)
    closing = -opening + dent(vertices, 1.5)
    shapes = {"jawOpen": opening, "mouthClose": closing, "mouthFunnel": dent(vertices, 2.0)}
    assert crossing_vertices(rest, opening + closing, WEIGHTS).any()
    found = parted_shapes(rest, shapes)
    assert list(found) == [*shapes, *VISEMES]
    np.testing.assert_array_equal(found["jawOpen"], opening)
    assert not crossing_vertices(rest, found["jawOpen"] + found["mouthClose"], EVERY).any()
    for name in VISEMES:
        assert not crossing_vertices(rest, found[name], EVERY).any(), name
    np.testing.assert_allclose(found["viseme_aa"], mixed(found, VISEMES["viseme_aa"]))
    assert not found["viseme_sil"].any()


HALF_MM = (10.0, 7.0)  # of what lids show, seen from ahead
GAZE = np.array([0.2, 0.1, np.sqrt(0.95)])
IRIS, PUPIL, WHITE = (90, 60, 30), (20, 20, 20), (210, 205, 200)
EYEBALL = Eyeball(np.array([31.0, 12.0, 60.0]), GAZE)


def photographed() -> PhotographedEyes:
    """The ball itself between lids, with an iris of 5 mm about the gaze in its texture, a texel 0.1 mm."""
    x, y = (np.linspace(-half, half, 41) for half in HALF_MM)
    aside = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    directions = np.column_stack([aside, np.sqrt(12.0**2 - (0.8 * aside**2).sum(axis=1))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    vertices = EYEBALL.centre + EYEBALL.reach(directions)[:, None] * directions
    faces = grid_faces(41, 41, closed=False)[:, ::-1].astype(np.int32)
    image = np.full((200, 200, 3), WHITE, np.uint8)
    uv = 0.5 + aside / (2.0 * HALF_MM[0]) * (1.0, -1.0)
    at = (np.stack(np.meshgrid(*[(np.arange(200) + 0.5) / 200] * 2), axis=2) - 0.5) * (20.0, -20.0)
    flat = at.reshape(-1, 2)
    there = np.column_stack([flat, np.sqrt(np.maximum(144.0 - 0.8 * (flat**2).sum(axis=1), 1.0))])
    angle = np.arccos(there @ GAZE / np.linalg.norm(there, axis=1)).reshape(200, 200)
    image[angle < np.arcsin(5.9 / 12.0)], image[angle < np.arcsin(2.0 / 12.0)] = IRIS, PUPIL
    atlas = Atlas(Layout(uv, faces, np.arange(len(aside))), image)
    return PhotographedEyes(Mesh(vertices, faces), np.arange(len(faces)), atlas)


def test_an_iris_lies_in_the_middle_of_its_picture() -> None:
    image = paint_eyeball(EYEBALL, photographed())
    assert image is not None
    middle = image[SIZE_PX // 2, SIZE_PX // 2].astype(int)
    assert np.abs(middle - PUPIL).max() < 5
    ring = image[SIZE_PX // 2, SIZE_PX // 2 + round(SIZE_PX * 20.0 / 360.0)].astype(int)  # 20 degrees off
    assert np.abs(ring - IRIS).max() < 5
    assert np.abs(image[5, 5].astype(int) - WHITE).max() < 5  # behind: what no photograph shows is white
    front = eyeball_uv(EYEBALL, Eyeball(EYEBALL.centre, AHEAD).mesh())[0]
    np.testing.assert_allclose(front, 0.5, atol=1e-9)


def test_an_iris_that_was_not_measured_is_what_is_dark() -> None:
    ahead = Eyeball(EYEBALL.centre, AHEAD)
    found = darkest_direction(ahead, photographed())
    assert found is not None
    assert np.degrees(np.arccos(found @ GAZE)) < 3.0  # an iris is cut by the lids on one side
    seen = photographed()
    assert seen.atlas is not None
    lid = Atlas(seen.atlas.layout, np.full((200, 200, 3), (190, 140, 120), np.uint8))
    assert darkest_direction(ahead, PhotographedEyes(seen.head, seen.between, lid)) is None


def slit_mm2(vertices: Float[np.ndarray, "v 3"], opened: Int[np.ndarray, "f 3"], middle: np.ndarray) -> float:
    """The area of what is seen between the lips from the front: rays that pass deeper than 15 mm behind them."""
    lens = Intrinsics(240, 120, 3000.0, 3000.0, 119.5, 59.5)
    camera = Camera("front", lens, look_at(middle + (0.0, 0.0, 500.0), middle, np.array([0.0, 1.0, 0.0])))
    depth, _ = depth_map(camera, vertices, opened)
    return float(np.count_nonzero(depth > 515.0)) / 36.0  # 6 px a mm


@pytest.mark.parametrize(("weight", "shuts"), [(0.02, True), (0.04, True), (0.4, False)])
def test_lips_are_shut_where_they_nearly_are(weight: float, shuts: bool) -> None:
    model = load_model()
    opened = opened_faces({name: model.levels[name].faces for name in ("cage", "full")})
    parted = model.vertices(np.zeros(0)) + model.levels["full"].operator @ model.expressions.moved({"jawOpen": weight})
    landmarks = {name: parted[row] for name, row in model.landmarks.items()}
    made, middle = shut_lips(parted, opened, landmarks), landmarks["stomion"]
    before, after = (slit_mm2(each, opened, middle) for each in (parted, made))
    assert before > 4.0
    assert after < 0.1 * before if shuts else after > 0.9 * before
    assert np.abs(made - parted).max() < 2.0 + PRESS_MM
    assert np.linalg.norm(parted[(made != parted).any(axis=1)] - middle, axis=1).max() < 40.0


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


def carried(model: HeadModel, mean: np.ndarray, binding: SurfaceBinding, faces: np.ndarray) -> dict[str, np.ndarray]:
    marks = {name: mean[row] for name, row in model.landmarks.items()}
    neutral = Neutral(mean, model.levels["full"].faces, binding.on(mean, model.levels["full"].faces))
    return carried_shapes(binding, faces, neutral, moves(model, *NAMES), marks)


def test_the_insides_of_lips_move_with_their_own_lip(model: HeadModel, mean: np.ndarray) -> None:
    binding, triangles = coarse(model, mean)
    found, rows = carried(model, mean, binding, triangles), model.levels["p95"].rows
    for name, shape in moves(model, *NAMES).items():
        true = shape[rows]
        error = np.linalg.norm(found[name] - true) / np.linalg.norm(true)
        smooth = binding.on(mean + shape, model.levels["full"].faces) - binding.on(mean, model.levels["full"].faces)
        assert error < 0.05, name
        if name != "eyeBlinkLeft":
            assert np.linalg.norm(smooth - true) / np.linalg.norm(true) > 2.0 * error, name


def test_eyeballs_stay_teeth_go_with_the_jaw_and_lashes_with_the_lid(
    model: HeadModel, mean: np.ndarray, points: dict[str, np.ndarray]
) -> None:
    shapes = moves(model, *NAMES)
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

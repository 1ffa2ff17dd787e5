"""Parts of planted subjects, drawn by the CPU rasteriser in colours that are known; and the steps on the way."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.imaging.silhouette import Silhouette, ViewQuality, silhouette_from_mask
from pipeline.part_labels.appearance_cells import head_guide, make_cells
from pipeline.part_labels.codes import CHANNELS, Part
from pipeline.part_labels.label_kernels import spread_parts
from pipeline.part_labels.labelling import (
    CELL_MM,
    classify_parts,
    colour_histogram,
    detail_histogram,
    guided,
    posterior,
    starts,
)
from rig.mesh import Mesh
from rig.rig import Rig
from rig.studio.scene.anatomy import anatomy, grid_faces
from rig.studio.scene.hair import HairStyle, grow, grow_beard
from rig.studio.scene.layout import default_layout
from rig.studio.scene.subject import Subject
from tests.rig.studio.test_images import egg_head

TONES = {
    "skin": (200.0, 150.0, 125.0),
    "dark": (70.0, 50.0, 38.0),
    "brown": (110.0, 80.0, 58.0),
    "blue": (60.0, 80.0, 150.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class Planted:
    """Photographs of a subject, and the true part of every pixel: 0 none, 1 skin, 2 hair, 3 clothes."""

    images: Mapping[str, np.ndarray]
    silhouettes: Mapping[str, Silhouette]
    truth: Mapping[str, np.ndarray]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return default_layout().subset(("cam00", "cam03", "cam04", "cam07")).scaled(0.5)


def shoulders() -> Mesh:
    """A cone below the egg's chin."""
    turn, drop = np.meshgrid(np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(0, 1, 20))
    reach = 45 + 110 * drop
    points = np.stack([reach * np.sin(turn), -100 - 90 * drop, reach * np.cos(turn)], axis=-1).reshape(-1, 3)
    return Mesh(points, grid_faces(20, 60))


def full_beard(head: Mesh) -> Mesh:
    style = HairStyle(thickness_mm=13.0, curl_mm=3.0, strands=0)
    grown = grow_beard(head, anatomy(head.vertices, egg_head().landmarks), style, np.random.default_rng(1))
    return Mesh(grown.shell, grown.shell_faces)


def swollen() -> Subject:
    """The egg as outlines alone fit it: its chin is the beard's."""
    bare = egg_head()
    beard, head = full_beard(bare.mesh).vertices, bare.mesh.vertices
    out = ((beard - head) * bare.mesh.normals()).sum(axis=1, keepdims=True)
    shape = np.where(out > 1.0, beard, head)
    _, row = KDTree(head).query(list(bare.landmarks.values()))
    moved = dict(zip(bare.landmarks, np.array(list(bare.landmarks.values())) + (shape - head)[row], strict=True))
    return replace(bare, mesh=replace(bare.mesh, vertices=shape), landmarks=moved)


def planted(
    rig: Rig, hair: str, clothes: str, gains: Mapping[str, float] | None = None, *, beard: bool = False
) -> Planted:
    """The egg with a shell of hair over its crown, or about its chin, lit from above; grain on the hair, noise on
    all."""
    head = egg_head().mesh
    style = HairStyle(thickness_mm=9.0, over_ears=True, strands=0)
    shell = grow(head.vertices, anatomy(head.vertices, egg_head().landmarks), style, np.random.default_rng(1))
    pieces = [(head, "skin", 1), (shoulders(), clothes, 1 if clothes == "skin" else 3)]
    if hair != "skin":
        pieces.append((Mesh(shell.shell, shell.shell_faces), hair, 2))
    if beard:
        pieces.append((full_beard(head), "brown", 2))
    rng, images, silhouettes, truth = np.random.default_rng(2), {}, {}, {}
    for camera in rig:
        k = camera.intrinsics
        nearest, part = np.full((k.height, k.width), np.inf), np.zeros((k.height, k.width), np.uint8)
        image = np.full((k.height, k.width, 3), 90.0)
        for mesh, tone, code in pieces:
            pixels = camera.project(mesh.vertices)
            depth, face = rasterise(pixels, depth_map_z(camera, mesh), mesh.faces, k.height, k.width)
            light = 0.75 + 0.25 * mesh.normals()[:, 1:2]
            lit = interpolate(face, pixels, depth_map_z(camera, mesh), mesh.faces, light.astype(np.float32))
            grain = rng.normal(0, 0.3 if code == 2 else 0.01, depth.shape)[:, :, None]
            front = depth < nearest
            image[front] = (np.array(TONES[tone]) * np.nan_to_num(lit) * (1 + grain))[front]
            nearest[front], part[front] = depth[front], code
        image = image * (gains or {}).get(camera.name, 1.0) + rng.normal(0, 2, image.shape)
        images[camera.name] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        silhouettes[camera.name], truth[camera.name] = silhouette_from_mask(part > 0), part
    return Planted(images, silhouettes, truth)


def depth_map_z(camera, mesh: Mesh) -> np.ndarray:
    return camera.camera_from_world.apply(mesh.vertices)[:, 2]


def shares(rig: Rig, made: Planted, fitted: Subject | None = None) -> dict[int, float]:
    """Share of each true part's pixels that are given to it with more than a half."""
    subject = fitted or egg_head()
    assert subject.face_region is not None
    found = classify_parts(
        made.images, made.silhouettes, rig, subject.mesh, subject.face_region, subject.landmarks,
        report=lambda stage, share: None,
    )  # fmt: skip
    right: dict[int, list[np.ndarray]] = {1: [], 2: [], 3: []}
    for name, each in found.items():
        for code, kept in right.items():
            kept.append(each.probability[..., Part(code).channel][made.truth[name] == code] > 0.5)
    return {code: float(np.concatenate(kept).mean()) for code, kept in right.items() if np.concatenate(kept).size}


@pytest.mark.parametrize(
    ("hair", "clothes", "gains", "least"),
    [
        ("dark", "blue", None, {1: 0.95, 2: 0.93, 3: 0.95}),  # a cell at the border of hair is mixed
        ("skin", "skin", None, {1: 0.97}),  # bald, with bare shoulders
        ("dark", "dark", None, dict.fromkeys((1, 2, 3), 0.9)),
        ("dark", "blue", {"cam03": 1.2, "cam07": 0.8}, dict.fromkeys((1, 2, 3), 0.9)),
    ],
)
def test_hair_clothes_and_skin_are_told_apart_in_one_colour_and_by_other_exposures(rig, hair, clothes, gains, least):
    found = shares(rig, planted(rig, hair, clothes, gains))
    assert found.keys() == least.keys()
    assert all(found[part] > share for part, share in least.items()), found


@pytest.mark.parametrize("hair", ["skin", "brown"])
def test_a_beard_is_hair_on_the_chin_and_below_it(rig, hair):
    found = shares(rig, planted(rig, hair, "blue", beard=True), swollen())
    assert found[1] > 0.93
    assert found[2] > 0.93
    assert found[3] > 0.95


def test_nothing_is_said_outside_the_subject_and_of_views_that_do_not_count(rig):
    made = planted(rig, "dark", "blue")
    unusable = replace(made.silhouettes["cam03"], quality=ViewQuality(usable=False))
    subject = egg_head()
    assert subject.face_region is not None
    found = classify_parts(
        made.images, {**made.silhouettes, "cam03": unusable}, rig, subject.mesh, subject.face_region,
        subject.landmarks, report=lambda stage, share: None,
    )  # fmt: skip
    assert set(found) == {"cam00", "cam04", "cam07"}
    for name, each in found.items():
        assert not each.probability[made.truth[name] == 0].any()
        assert each.probability.min() >= 0.0
        assert each.probability.sum(axis=2).max() <= 1.0 + 1e-6


def test_starts_lie_on_the_cheeks_over_the_crown_and_below_the_neck(rig):
    subject, made = egg_head(), planted(rig, "dark", "blue")
    assert subject.face_region is not None
    guide = head_guide(subject.mesh, subject.face_region, subject.landmarks)
    masks = {name: part > 0 for name, part in made.truth.items()}
    for view in make_cells(made.images, masks, rig, guide, CELL_MM):
        half = view.size_px // 2
        truth = made.truth[view.camera.name][half :: view.size_px, half :: view.size_px]
        start = starts(view)
        truth = truth[: start.shape[0], : start.shape[1]]
        for part in CHANNELS:
            sure = truth[(start[..., part.channel] > 0) & (view.inside > 0.9)]
            assert sure.size > 20
            assert (sure == part).mean() > 0.9


def test_guide_measures_from_the_border_of_the_face_and_the_chin():
    subject = egg_head()
    assert subject.face_region is not None
    guide = head_guide(subject.mesh, subject.face_region, subject.landmarks)
    np.testing.assert_array_equal(guide.into_face_mm >= 0, subject.face_region | (guide.into_face_mm == 0))
    assert guide.above_chin_mm[np.argmax(subject.mesh.vertices[:, 1])] == pytest.approx(220, abs=25)
    nose = np.argmin(np.linalg.norm(subject.mesh.vertices - subject.landmarks["pronasale"], axis=1))
    eye = (subject.landmarks["exocanthion_left"] + subject.landmarks["endocanthion_left"]) / 2
    assert guide.feature[np.argmin(np.linalg.norm(subject.mesh.vertices - eye, axis=1))] > 0.9
    assert guide.into_face_mm[nose] > 40


def test_looks_are_probabilities():
    rng = np.random.default_rng(3)
    colour, detail, weight = rng.integers(0, 20_000, 500), rng.integers(0, 20, 500), rng.random(500).astype(np.float32)
    for histogram in (
        colour_histogram(colour, weight),
        detail_histogram(detail, weight),
        colour_histogram(colour, 0 * weight),
    ):
        assert histogram.min() > 0
        assert histogram.sum() <= 1 + 1e-6


def test_posterior_is_bayes_rule():
    logs = np.log(np.array([[0.2, 0.1, 0.4, 0.05]]))
    prior = np.array([[0.5, 0.25, 0.15, 0.1]])
    joint = np.array([0.1, 0.025, 0.06, 0.005])
    np.testing.assert_allclose(posterior(logs.astype(np.float32), prior)[0], (joint / joint.sum())[:3], rtol=1e-5)


def test_guided_filter_keeps_the_photographs_steps_alone_and_knows_nothing_of_what_has_no_weight():
    step = np.zeros((40, 40), np.float32)
    step[:, 20:] = 1.0
    flat, weight = np.full_like(step, 0.5), np.ones_like(step)
    values = np.repeat(step[..., None], 3, axis=2)
    slope, offset = guided(step, values, weight, 3, 0.02)
    np.testing.assert_allclose(slope[..., 0] * step + offset[..., 0], step, atol=0.01)
    slope, offset = guided(flat, values, weight, 3, 0.02)
    smooth = slope[..., 0] * flat + offset[..., 0]
    assert np.abs(np.diff(smooth[20])).max() < 0.2
    values = np.zeros((30, 30, 3), np.float32)
    weight = np.zeros((30, 30), np.float32)
    weight[:, :15], values[:, :15], values[:, 15:] = 1.0, 0.7, 1e3
    slope, offset = guided(np.full((30, 30), 0.3, np.float32), values, weight, 3, 0.05)
    np.testing.assert_allclose((slope * 0.3 + offset)[:, :15], 0.7, rtol=1e-4)


def test_parts_are_spread_to_pixels_as_an_image_is_enlarged():
    """OpenCV's enlargement is the oracle, its outermost pixels repeated beyond the whole cells."""
    rng, size = np.random.default_rng(1), 5
    slope, offset = rng.normal(size=(2, 6, 8, 3)).astype(np.float32)
    grey = rng.integers(0, 256, (33, 44), dtype=np.uint8)
    mask = rng.random((33, 44)) < 0.7
    wide, level = (cv2.resize(each, (40, 30), interpolation=cv2.INTER_LINEAR) for each in (slope, offset))
    wide, level = (cv2.copyMakeBorder(each, 0, 3, 0, 4, cv2.BORDER_REPLICATE) for each in (wide, level))
    expected = np.clip(wide * (grey / 255.0)[..., None] + level, 0.0, 1.0) * mask[..., None]
    expected /= np.maximum(expected.sum(axis=2, keepdims=True), 1.0)
    found = np.zeros((33, 44, 3), np.uint8)
    spread_parts(slope, offset, size, grey, mask, found)
    np.testing.assert_allclose(found[..., :2], 255 * expected[..., :2], atol=0.5 + 255e-5)
    np.testing.assert_allclose(found[..., 2], 255 * expected[..., 2], atol=1.0 + 255e-5)  # gives way where all are full
    assert found.sum(axis=2).max() == 255

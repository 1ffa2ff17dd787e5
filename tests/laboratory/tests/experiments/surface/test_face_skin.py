"""Normals and craters of a surface over the true face."""

from dataclasses import replace

import numpy as np
import pytest

from rig.capture import Capture
from rig.mesh import Mesh
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.visible import VisiblePoints
from tests.laboratory.experiments.paper.detail import Known
from tests.laboratory.experiments.surface.face_skin import (
    FacePlaces,
    crater_map,
    face_places,
    find_craters,
    normal_figures,
    shining_places,
)
from tests.support.scenes import ellipsoid

GREY, BRIGHT = 120, 220


@pytest.fixture(scope="module")
def known() -> Known:
    """A head of which a cap towards the first camera is the face, and seen."""
    truth, rig = ellipsoid(5), default_layout()
    truth = Mesh(truth.vertices - truth.vertices.mean(axis=0) + rig.centre_world(), truth.faces)
    normals = truth.normals()
    towards = rig.cameras[0].centre_world - rig.centre_world()
    front = normals @ towards > 0.9 * np.linalg.norm(towards)
    count = int(front.sum())
    seen = VisiblePoints(
        truth.vertices[front].astype(np.float32), normals[front].astype(np.float32),
        np.zeros(count, np.uint8), np.full(count, 3, np.uint8),
    )  # fmt: skip
    shape = (rig.cameras[0].intrinsics.height, rig.cameras[0].intrinsics.width, 3)
    images = {name: np.full(shape, GREY, np.uint8) for name in rig.names}
    return Known("ball", Capture(images), rig, truth, front, seen)


@pytest.fixture(scope="module")
def places(known: Known) -> FacePlaces:
    return face_places(known)


def dented(known: Known, centre: np.ndarray, deep_mm: float, wide_mm: float) -> Mesh:
    away = np.linalg.norm(known.mesh.vertices - centre, axis=1)
    depth = deep_mm * np.exp(-0.5 * (away / wide_mm) ** 2)
    return Mesh(known.mesh.vertices - depth[:, None] * known.mesh.normals(), known.mesh.faces)


def middle(known: Known, places: FacePlaces) -> np.ndarray:
    towards = known.rig.cameras[0].centre_world - known.rig.centre_world()
    return places.points[(places.points @ towards).argmax()]


def test_a_patch_below_what_is_around_it_is_one_crater(known: Known, places: FacePlaces) -> None:
    everywhere = np.ones(len(places.points), bool)
    at = middle(known, places)
    deep = find_craters(places, dented(known, at, 1.5, 3.0), everywhere)
    assert deep.figures()["craters"] == deep.figures()["craters_at_highlights"] == 1.0
    assert np.linalg.norm(places.points[deep.crater >= 0] - at, axis=1).max() < 6.0
    assert 0.8 < deep.figures()["deepest_at_highlight_mm"] < 1.5  # less the mean about it
    shallow = find_craters(places, dented(known, at, 0.4, 3.0), everywhere)
    assert shallow.figures()["craters"] == 0.0
    matt = find_craters(places, dented(known, at, 1.5, 3.0), ~everywhere)
    assert (matt.figures()["craters"], matt.figures()["craters_at_highlights"]) == (1.0, 0.0)


def test_a_head_that_lies_evenly_deep_has_no_crater(known: Known, places: FacePlaces) -> None:
    lower = Mesh(known.mesh.vertices - 2.0 * known.mesh.normals(), known.mesh.faces)
    assert find_craters(places, lower, np.ones(len(places.points), bool)).figures()["craters"] == 0.0


def test_normals_are_compared_where_both_surfaces_face_the_same_way(known: Known, places: FacePlaces) -> None:
    same = normal_figures(places, known.mesh)
    assert same["normals_p95_deg"] < 2.0
    rough = dented(known, middle(known, places), 2.0, 2.0)
    assert normal_figures(places, rough)["normals_median_deg"] < 2.0
    rng = np.random.default_rng(3)
    noisy = Mesh(known.mesh.vertices + rng.normal(0.0, 0.3, known.mesh.vertices.shape), known.mesh.faces)
    assert normal_figures(places, noisy)["normals_p95_deg"] > 5.0


def test_what_one_view_sees_brighter_than_the_others_shines(known: Known, places: FacePlaces) -> None:
    plain = shining_places(places, known.capture.images, known.rig, known.mesh)
    assert not plain.any()
    camera, at = known.rig.cameras[0], middle(known, places)
    column, row = np.rint(camera.project(at[None])[0]).astype(int)
    images = dict(known.capture.images)
    lit = images[camera.name].copy()
    lit[row - 12 : row + 13, column - 12 : column + 13] = BRIGHT
    images[camera.name] = lit
    shining = shining_places(places, images, known.rig, known.mesh)
    assert shining.any()
    assert np.linalg.norm(places.points[shining] - at, axis=1).max() < 25.0
    brighter = dict(known.capture.images) | {camera.name: np.full_like(lit, BRIGHT)}  # its exposure
    assert not shining_places(places, brighter, known.rig, known.mesh).any()


def test_two_views_do_not_tell_which_of_them_shines(known: Known, places: FacePlaces) -> None:
    pair = Rig(known.rig.cameras[:2])
    images = {pair.names[0]: known.capture.images[pair.names[0]], pair.names[1]: np.full_like(
        known.capture.images[pair.names[1]], BRIGHT)}  # fmt: skip
    assert not shining_places(places, images, pair, known.mesh).any()


def test_the_map_shows_highlights_blue_and_craters_red(known: Known, places: FacePlaces) -> None:
    at = middle(known, places)
    near = np.linalg.norm(places.points - at, axis=1) < 20.0
    craters = find_craters(places, dented(known, at, 2.5, 3.0), near)
    towards = known.rig.cameras[0].camera_from_world.rotation * np.array([[1.0], [-1.0], [-1.0]])
    local = Mesh(known.mesh.vertices @ towards.T, known.mesh.faces)
    drawn = crater_map(craters, places.points @ towards.T, local).astype(int)
    blue, red = drawn[:, :, 2] - drawn[:, :, 0], drawn[:, :, 0] - drawn[:, :, 2]
    assert (blue > 40).sum() > 50
    assert (red > 40).sum() > 10
    matt = replace(craters, shining=np.zeros_like(near), depth_mm=np.zeros_like(craters.depth_mm))
    grey = crater_map(matt, places.points @ towards.T, local).astype(int)
    assert np.ptp(grey, axis=2).max() <= 2

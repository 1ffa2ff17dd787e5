"""A surface drawn to points: analytic shapes, planted faults, and the default head."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.posterior import vertex_deviation_mm
from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.eyelids import EyeEvidence, bridge_eyelids
from pipeline.detail.refine import SHARED_ERROR, DeformedSurface, deform_to_points, is_folded, refine_to_surface, unfold
from pipeline.fusion.untangling import head_topology, spoilt_faces
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from pipeline.part_labels.codes import Part
from rig.geometry import Similarity
from rig.mesh import vertex_normals
from tests.support.subdivided_spheres import ellipsoid_distance, ellipsoid_points, subdivided_sphere

AXES_MM = np.array([82.0, 79.0, 81.0])
NOISE_MM = 0.2


def drawn(
    surface: SurfacePoints, deviation_mm: float = 1.5, shared_error: float = SHARED_ERROR
) -> tuple[np.ndarray, np.ndarray, DeformedSurface]:
    """The sphere, its faces, and what the points make of it."""
    vertices, faces, nodes = subdivided_sphere()
    loose = np.zeros(len(vertices), bool)
    found = deform_to_points(
        vertices, np.full(len(vertices), deviation_mm), faces, nodes, surface, loose=loose, shared_error=shared_error
    )
    return vertices, faces, found


def test_a_sphere_becomes_the_ellipsoid_that_the_points_show() -> None:
    vertices, faces, found = drawn(ellipsoid_points(np.random.default_rng(0), AXES_MM, NOISE_MM))
    off = ellipsoid_distance(found.vertices, AXES_MM)
    # Half a point a mm^2: within a correlated length of the field (5 mm) some 40 points, 0.2 / sqrt(40) = 0.03 mm, and
    # chords of 5 mm sag by 0.04 mm.
    assert np.sqrt((off**2).mean()) < 0.07
    assert not is_folded(vertices, found.vertices, faces).any()
    held = np.abs(off) < 1.96 * found.deviation_mm
    assert 0.93 <= held.mean() <= 1.0
    slid = found.vertices - vertices
    slid -= (slid * vertices).sum(axis=1, keepdims=True) * vertices / 80.0**2
    assert np.linalg.norm(slid, axis=1).max() < 0.6  # the same vertex stays the same place


def test_a_share_of_the_points_deviation_stays_however_many_they_are() -> None:
    surface = ellipsoid_points(np.random.default_rng(0), AXES_MM, NOISE_MM)
    factor = np.where(surface.points[:, 0] > 0.0, 2.0, 6.0)
    unsure = replace(surface, deviation_mm=factor * surface.deviation_mm)
    vertices, _, stated = drawn(unsure)
    alone = drawn(unsure, shared_error=0.0)[2]
    added = np.sqrt(stated.deviation_mm**2 - alone.deviation_mm**2)
    for side, factor in ((vertices[:, 0] > 20.0, 2.0), (vertices[:, 0] < -20.0, 6.0)):
        np.testing.assert_allclose(added[side], 0.25 * factor * NOISE_MM, rtol=0.02)


def test_the_result_repeats_to_the_bit_and_without_points_nothing_moves() -> None:
    surface = ellipsoid_points(np.random.default_rng(0), AXES_MM, NOISE_MM, 10_000)
    first, second = drawn(surface)[2], drawn(surface)[2]
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.deviation_mm, second.deviation_mm)
    none = SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.uint8))
    vertices, _, found = drawn(none)
    np.testing.assert_array_equal(found.vertices, vertices)
    assert np.isfinite(found.deviation_mm).all()


def test_outliers_do_not_pull() -> None:
    rng = np.random.default_rng(5)
    surface = ellipsoid_points(rng, AXES_MM, NOISE_MM)
    points = surface.points.copy()
    stray = rng.random(len(points)) < 0.05
    points[stray] += surface.normals[stray] * rng.uniform(-15.0, 15.0, (stray.sum(), 1))
    clean = drawn(surface)[2]
    found = drawn(SurfacePoints(points, surface.normals, surface.deviation_mm, surface.part))[2]
    assert np.abs(found.vertices - clean.vertices).max() < 0.3
    assert np.sqrt((ellipsoid_distance(found.vertices, AXES_MM) ** 2).mean()) < 0.09


def test_where_no_point_speaks_the_surface_carries_on_and_says_how_sure_it_is() -> None:
    surface = ellipsoid_points(np.random.default_rng(0), AXES_MM, NOISE_MM)
    vertices, _, found = drawn(surface.chosen(surface.points[:, 2] > 0.0))
    behind = vertices[:, 2] < -60.0
    # Four lengths from the nearest point the coarse field keeps x K_1(x) = 0.05 of the 2 mm that it moves there.
    assert np.abs(found.vertices - vertices)[behind].max() < 0.1
    assert np.median(found.deviation_mm[behind]) == pytest.approx(1.5, rel=0.15)
    assert not found.observed[vertices[:, 2] < -10.0].any()
    rim = (vertices[:, 2] < -2.0) & (vertices[:, 2] > -6.0)
    moved = np.linalg.norm(found.vertices - vertices, axis=1)
    assert moved[rim].mean() > 0.4 * moved[vertices[:, 2] > 2.0].mean()  # no step at the border


def test_hair_bounds_and_does_not_pull() -> None:
    rng = np.random.default_rng(2)
    outside, inside = ellipsoid_points(rng, np.full(3, 84.0), 0.1), ellipsoid_points(rng, np.full(3, 77.5), 0.1)
    hair = np.full(len(outside.points), Part.HAIR, np.uint8)
    for surface, radius in ((outside, 80.0), (inside, 77.5)):
        found = drawn(SurfacePoints(surface.points, surface.normals, surface.deviation_mm, hair))[2]
        # Points that are met fall silent, those beyond go on: inwards by three of their deviations at most.
        off = np.linalg.norm(found.vertices, axis=1) - radius
        assert -0.6 < off.min() <= off.max() < 0.15
        assert not found.observed.any()


def head_points(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> SurfacePoints:
    """Vertices of a head that stand in the front half, with noise along their normals."""
    normals = vertex_normals(vertices, faces)
    rows = np.flatnonzero(vertices[:, 2] > -20.0)
    points = vertices[rows] + normals[rows] * rng.normal(0.0, NOISE_MM, (len(rows), 1))
    return SurfacePoints(points, normals[rows], np.full(len(rows), NOISE_MM), np.full(len(rows), Part.SKIN, np.uint8))


@pytest.mark.slow
def test_a_planted_head_is_found_within_its_intervals(model: HeadModel) -> None:
    rng = np.random.default_rng(11)
    faces, count = model.levels["full"].faces, 60
    truth = model.vertices(rng.normal(0.0, 0.5, count))
    spread = 0.3  # of each coefficient about the truth
    fit = Fit("contour", np.zeros(count), Similarity(1.0, np.eye(3), np.zeros(3)), 1, "planted",
              covariance=np.diag([spread**2] * count + [1e-8] * 7))  # fmt: skip
    start = model.vertices(fit.coefficients)
    found = refine_to_surface(
        fit, model, head_points(truth, faces, rng), eigenheads=count, deviation_mm=vertex_deviation_mm(model, fit)
    )
    normals = vertex_normals(truth, faces)
    before, after = (np.abs(((at - truth) * normals).sum(axis=1)) for at in (start, found.vertices))
    face = model.levels["full"].face_region & found.observed
    assert np.median(after[face]) < 0.1 < 0.3 < np.median(before[face])
    assert np.median(after[head_regions(model)["ears"] & found.observed]) < 0.5
    assert not is_folded(start, found.vertices, faces).mean() > 2e-3
    assert not spoilt_faces(found.vertices, head_topology(model)).any()
    assert found.closed_eyes == frozenset()


@pytest.mark.slow
def test_closed_lids_bridge_the_opening(model: HeadModel) -> None:
    faces = model.levels["full"].faces
    open_head = model.vertices(np.zeros(0))
    truth = bridge_eyelids(open_head, model, frozenset({"right", "left"}))
    fit = Fit("contour", np.zeros(0), Similarity(1.0, np.eye(3), np.zeros(3)), 1, "planted", np.diag([1e-8] * 7))
    surface = head_points(truth, faces, np.random.default_rng(12))
    shown = {"right": EyeEvidence(0.0, 0.01, 5), "left": EyeEvidence(0.0, 0.01, 5)}
    found = refine_to_surface(fit, model, surface, eigenheads=0, deviation_mm=np.zeros(len(truth)), eyes=shown)
    assert found.closed_eyes == {"right", "left"}
    eyes = head_regions(model)["eyes"]
    off = np.abs(((found.vertices - truth) * vertex_normals(truth, faces)).sum(axis=1))[eyes]
    assert off.mean() < 0.15
    assert not is_folded(truth, found.vertices, faces)[eyes[faces].all(axis=1)].any()
    assert not spoilt_faces(found.vertices, head_topology(model)).any()


def test_white_or_iris_between_the_lids_means_open() -> None:
    assert EyeEvidence(white=0.0, dark=0.02, views=3).closed
    assert not EyeEvidence(white=0.1, dark=0.0, views=3).closed
    assert not EyeEvidence(white=0.0, dark=0.3, views=3).closed
    assert not EyeEvidence(white=0.0, dark=0.0, views=0).closed


def test_a_planted_fold_gives_way_and_what_is_smooth_stays() -> None:
    vertices, faces, _ = subdivided_sphere()
    moved = vertices.copy()
    moved[500] += 3.0 * (vertices[faces[(faces == 500).any(axis=1)][0]].mean(axis=0) - vertices[500])
    assert is_folded(vertices, moved, faces).any()
    mended = unfold(vertices, moved, faces)
    assert not is_folded(vertices, mended, faces).any()
    far = np.linalg.norm(vertices - vertices[500], axis=1) > 50.0
    np.testing.assert_array_equal(mended[far], moved[far])
    moved = vertices * (1.0 + 0.02 * np.sin(vertices[:, :1] / 20.0))
    assert not is_folded(vertices, moved, faces).any()
    assert unfold(vertices, moved, faces) is moved

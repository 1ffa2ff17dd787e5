"""Planted errors and scatter come out as the figures that they are; limits are settings."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.applications.verification.judgement import Limits, checks, judge, judge_one, scatter, weighted_range
from pipeline.applications.verification.reference import Reference
from pipeline.head_model.subdivision import vertex_areas
from rig.errors import InputError
from rig.geometry import RigidTransform, rotation_from_vector
from rig.mesh import Mesh
from rig.typed_tables import read_table
from tests.support.measured_heads import mannequin, marks, measured_head
from tests.support.scenes import ellipsoid
from tests.support.visits import bumped

SCAN = Reference.of(mannequin(), marks(), "scan.ply")
SHIFT_MM = np.array([3.0, -40.0, 8.0])
TOP = int(np.argmin(np.linalg.norm(mannequin().vertices - marks()["glabella"], axis=1)))


def test_a_perfect_head_has_no_error_wherever_it_lies() -> None:
    found = judge([measured_head(), measured_head(name="again")], SCAN, Limits())
    assert found.passed
    assert {check.name: check.passed for check in found.checks} == dict.fromkeys(Limits.__slots__, True)
    assert found.captures[0].regions["face"].rms_mm < 1e-3
    assert found.repeatability["face"]["rms_mm"] < 1e-6
    measured, true = found.captures[0].distances_mm["mouth_breadth"]
    assert measured == pytest.approx(true)
    shifted = {name: point + SHIFT_MM for name, point in marks().items()}
    elsewhere = Reference.of(replace(mannequin(), vertices=mannequin().vertices + SHIFT_MM), shifted)
    assert judge_one(measured_head(), elsewhere).regions["face"].p95_mm < 1e-2


def test_a_reference_one_percent_larger_is_a_size_error_and_fails() -> None:
    """Every distance is 1 / 1.01 of the reference's; the surfaces differ by no more than 1 % of the head's radius."""
    larger = Reference.of(
        replace(mannequin(), vertices=1.01 * mannequin().vertices), {k: 1.01 * v for k, v in marks().items()}
    )
    one = judge_one(measured_head(), larger)
    assert one.size_error_percent == pytest.approx(100.0 * (1 / 1.01 - 1), abs=1e-3)
    for measured, true in one.distances_mm.values():
        assert measured == pytest.approx(true / 1.01, rel=1e-9)
    radius = np.linalg.norm(mannequin().vertices, axis=1).max()
    assert 0.1 < one.regions["face"].rms_mm < 0.01 * radius
    assert not judge([measured_head()], larger, Limits()).passed
    assert judge([measured_head()], larger, Limits(size_error_percent=1.0, face_rms_mm=9.0, features_rms_mm=9.0)).passed


def test_a_bump_is_found_where_it_is_and_as_high_as_it_is() -> None:
    one = judge_one(measured_head(bumped("glabella", 2.0, 12.0)), SCAN)
    # The fit gives way by the bump's mean over the face: 2 mm * pi * 144 mm2 of 25,000 mm2 or so, and for the tilt.
    assert one.deviation_mm[TOP] == pytest.approx(2.0, abs=0.25)
    assert np.nanargmax(one.deviation_mm) == TOP
    assert one.probing_form_mm == pytest.approx(2.0, abs=0.5)
    assert one.regions["face"].mean_mm == pytest.approx(0.0, abs=0.05)
    assert one.regions["mouth"].rms_mm < 0.2
    assert judge_one(measured_head(bumped("glabella", -2.0, 12.0)), SCAN).deviation_mm[TOP] == pytest.approx(
        -2.0, abs=0.25
    )


def test_what_every_capture_repeats_is_told_from_what_scatters() -> None:
    """Two heads with bumps of 1 and 3 mm: 2 mm in common, scatter of sqrt(2) mm at the top."""
    found = judge(
        [measured_head(bumped("glabella", h, 12.0), str(h)) for h in (1.0, 3.0)], SCAN, Limits(repeatability_mm=0.05)
    )
    assert found.repeated_mm[TOP] == pytest.approx(2.0, abs=0.3)
    failed = {check.name for check in found.checks if check.passed is False}
    assert "repeatability_mm" in failed


def test_half_a_scan_covers_half_a_face() -> None:
    kept = mannequin().vertices[mannequin().faces].mean(axis=1)[:, 0] > -5.0
    left = {name: marks()[name] for name in ("pronasale", "cheilion_left", "exocanthion_left")}
    half = Reference.of(Mesh(mannequin().vertices, mannequin().faces[kept]), left)
    found = judge([measured_head()], half, Limits())
    covered = found.captures[0].regions["face"].covered
    assert 0.4 < covered < 0.7
    assert {check.name for check in found.checks if check.passed is False} == {"least_covered"}
    assert found.captures[0].regions["face"].rms_mm < 1e-2
    assert {check.name for check in found.checks if check.passed is None} == {"distance_mm", "repeatability_mm"}


def test_a_scan_that_faces_inwards_is_named() -> None:
    inside_out = Reference.of(Mesh(mannequin().vertices, mannequin().faces[:, ::-1].copy()), marks(), "scan.obj")
    with pytest.raises(InputError, match=r"scan\.obj: faces inwards"):
        judge_one(measured_head(), inside_out)


def test_the_range_leaves_out_the_tails_weight() -> None:
    values, weights = np.arange(1001.0), np.ones(1001)
    assert weighted_range(values, weights, 0.9) == pytest.approx(900.0, abs=1.5)
    assert weighted_range(np.r_[values, 1e9], np.r_[weights, 1e-9], 0.997) < 1001


def test_limits_are_read_and_wrong_ones_named() -> None:
    assert read_table(Limits, {"face_rms_mm": 1}, "limits") == Limits(face_rms_mm=1.0)
    with pytest.raises(InputError) as error:
        read_table(Limits, {"face_rms": 1.0, "least_covered": "much"}, "limits.toml")
    assert "limits.toml: unknown key 'face_rms'; did you mean 'face_rms_mm'?" in str(error.value)
    assert "least_covered is 'much'; expected a finite number" in str(error.value)


def test_the_most_and_the_least() -> None:
    values = dict.fromkeys(Limits.__slots__, None) | {"face_rms_mm": 0.5, "least_covered": 0.5, "distance_mm": 3.0}
    passed = {check.name: check.passed for check in checks(Limits(face_rms_mm=0.4, distance_mm=3.0), values)}
    assert (passed["face_rms_mm"], passed["least_covered"], passed["distance_mm"]) == (False, False, True)
    assert passed["repeatability_mm"] is None
    assert checks(Limits(face_rms_mm=0.5), values)[0].passed


HEAD = ellipsoid(3)  # 642 vertices
EVERYWHERE = np.ones(len(HEAD.vertices), bool)
AREAS = vertex_areas(HEAD.vertices, HEAD.faces)


def seated(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return RigidTransform(rotation_from_vector(rng.normal(0, 0.3, 3)), rng.normal(0, 40, 3)).apply(vertices)


def test_poses_are_no_scatter_and_one_head_has_none() -> None:
    rng = np.random.default_rng(1)
    heads = np.stack([seated(HEAD.vertices, rng) for _ in range(5)])
    found = scatter(heads, HEAD.faces, EVERYWHERE)
    assert found.position_mm.max() < 1e-6
    np.testing.assert_allclose(found.mean, heads[0], atol=1e-6)
    with pytest.raises(ValueError, match="two are needed"):
        scatter(heads[:1], HEAD.faces, EVERYWHERE)


def test_planted_scatter_is_found_and_compared_with_what_was_stated() -> None:
    rng = np.random.default_rng(2)
    stated = np.where(HEAD.vertices[:, 2] > 0, 0.1, 0.3)  # mm along the normal
    normals = HEAD.normals()
    noisy = [HEAD.vertices + normals * (stated * rng.standard_normal(len(stated)))[:, None] for _ in range(40)]
    found = scatter(np.stack([seated(head, rng) for head in noisy]), HEAD.faces, EVERYWHERE)
    front = found.figures(stated, AREAS, HEAD.vertices[:, 2] > 20)
    figures = found.figures(stated, AREAS, EVERYWHERE)
    # 39 degrees of freedom at each of some 250 vertices: the RMS is known to 1 %; the motions take 6 of 642 away.
    assert front["rms_mm"] == pytest.approx(0.1, rel=0.05)
    assert figures["normal_rms_mm"] == pytest.approx(figures["stated_mm"], rel=0.05)
    assert figures["scatter_over_stated"] == pytest.approx(1.0, rel=0.05)
    assert figures["rank_correlation"] > 0.8
    assert figures["normal_rms_mm"] <= figures["rms_mm"] <= figures["p95_mm"]


def test_a_size_that_changes_is_scatter() -> None:
    heads = np.stack([scale * HEAD.vertices for scale in (0.99, 1.01)])
    found = scatter(heads, HEAD.faces, EVERYWHERE)
    radius = np.linalg.norm(HEAD.vertices - HEAD.vertices.mean(axis=0), axis=1)
    np.testing.assert_allclose(found.position_mm, np.sqrt(2.0) * 0.01 * radius, rtol=1e-6)

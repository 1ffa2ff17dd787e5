"""Planted errors come out as the figures that they are."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.applications.verification.judgement import Limits, judge, judge_one, weighted_range
from pipeline.applications.verification.reference import Reference
from rig.errors import InputError
from rig.mesh import Mesh
from tests.support.measured_heads import mannequin, marks, measured_head

SCAN = Reference.of(mannequin(), marks(), "scan.ply")
SHIFT_MM = np.array([3.0, -40.0, 8.0])
TOP = int(np.argmin(np.linalg.norm(mannequin().vertices - marks()["glabella"], axis=1)))


def bumped(height_mm: float, radius_mm: float = 12.0) -> np.ndarray:
    """The mannequin with a bump on its forehead."""
    vertices, normals = mannequin().vertices, mannequin().normals()
    away = np.linalg.norm(vertices - marks()["glabella"], axis=1)
    return vertices + (height_mm * np.exp(-((away / radius_mm) ** 2)))[:, None] * normals


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
    one = judge_one(measured_head(bumped(2.0)), SCAN)
    # The fit gives way by the bump's mean over the face: 2 mm * pi * 144 mm2 of 25,000 mm2 or so, and for the tilt.
    assert one.deviation_mm[TOP] == pytest.approx(2.0, abs=0.25)
    assert np.nanargmax(one.deviation_mm) == TOP
    assert one.probing_form_mm == pytest.approx(2.0, abs=0.5)
    assert one.regions["face"].mean_mm == pytest.approx(0.0, abs=0.05)
    assert one.regions["mouth"].rms_mm < 0.2
    assert judge_one(measured_head(bumped(-2.0)), SCAN).deviation_mm[TOP] == pytest.approx(-2.0, abs=0.25)


def test_what_every_capture_repeats_is_told_from_what_scatters() -> None:
    """Two heads with bumps of 1 and 3 mm: 2 mm in common, scatter of sqrt(2) mm at the top."""
    found = judge([measured_head(bumped(h), str(h)) for h in (1.0, 3.0)], SCAN, Limits(repeatability_mm=0.05))
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

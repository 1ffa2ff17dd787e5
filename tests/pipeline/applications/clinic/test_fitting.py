"""Measures against bodies whose measures are known in closed form, and against another program's section;
sizes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.special import ellipe

from pipeline.applications.clinic import fitting
from pipeline.applications.clinic.fitting import (
    SizeTable,
    UprightHead,
    choose_size,
    fitting_measures,
    hull_perimeter,
    read_size_tables,
    section,
)
from rig.errors import InputError
from rig.studio.scene.anatomy import grid_faces
from tests.support.measured_heads import mannequin
from tests.support.visits import MOVED, moved, visit


def body(vertices: np.ndarray, faces: np.ndarray, **marks: tuple[float, float, float]) -> UprightHead:
    """A body in RAS axes: x to the right, y to the front, z up."""
    points = {name: np.array(point) for name, point in marks.items()}
    return UprightHead(np.asarray(vertices, float), np.asarray(faces), points, np.zeros(len(vertices), bool))


def test_the_tape_around_an_ellipsoid_is_its_ellipse() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5)
    side, front, up = 75.0, 95.0, 110.0
    head = body(ball.vertices * (side, front, up), ball.faces, glabella=(0.0, front, 0.0))
    found = fitting.head_circumference(head)
    assert found == pytest.approx(4.0 * front * ellipe(1.0 - (side / front) ** 2), rel=1e-3)
    flat = body(ball.vertices * (75, 20, 110), ball.faces, glabella=(0.0, 20.0, 0.0))
    assert fitting.head_circumference(flat) is None


def test_a_section_is_that_of_another_program_and_a_tape_spans_hollows() -> None:
    head, normal, origin = mannequin(), np.array([0.1, 0.95, 0.2]), np.array([0.0, 40.0, 0.0])
    found = section(head.vertices, head.faces, origin, normal)
    mesh = trimesh.Trimesh(head.vertices, head.faces, process=False)
    other = trimesh.intersections.mesh_plane(mesh, normal / np.linalg.norm(normal), origin)
    points = np.unique(np.round(np.asarray(other).reshape(-1, 3), 6), axis=0)
    np.testing.assert_allclose(np.unique(np.round(found, 6), axis=0), points, atol=2e-6)
    star = np.array([(0, 0), (4, 0), (4, 3), (2, 1), (0, 3)], float)
    assert hull_perimeter(star) == pytest.approx(14.0)
    assert hull_perimeter(np.zeros((5, 2))) is None


def roof(splay_deg: float, frontal_deg: float) -> UprightHead:
    """A nose of two planes, whose crest runs straight down at y = 0 from nasion at z = 0."""
    across, down = np.meshgrid(np.linspace(-20.0, 20.0, 41), np.linspace(10.0, -30.0, 41))
    widening = np.tan(np.radians(frontal_deg)) * -down
    away = np.maximum(np.abs(across) - np.maximum(widening, 0.0), 0.0)
    vertices = np.stack([across, -away / np.tan(np.radians(splay_deg)), down], axis=2).reshape(-1, 3)
    faces = grid_faces(41, 41, closed=False)[:, ::-1]
    corners = {"endocanthion_right": (18.0, -15.0, 0.0), "endocanthion_left": (-18.0, -15.0, 0.0)}
    return body(vertices, faces, nasion=(0.0, 0.0, 0.0), **corners)


@pytest.mark.parametrize("splay_deg", [20.0, 30.0])
@pytest.mark.parametrize("frontal_deg", [0.0, 15.0])
def test_a_nose_of_planes_has_its_widths_and_angles(splay_deg: float, frontal_deg: float) -> None:
    nose = roof(splay_deg, frontal_deg)
    flat = 2.0 * np.tan(np.radians(frontal_deg)) * fitting.BRIDGE_BELOW_NASION_MM
    width = flat + 2.0 * fitting.PAD_DEPTH_MM * np.tan(np.radians(splay_deg))
    assert fitting.bridge_width(nose) == pytest.approx(width, abs=0.35)  # edges of 1 mm round the ridges off
    assert fitting.splay_angle(nose) == pytest.approx(splay_deg, abs=1.0)
    assert fitting.frontal_angle(nose) == pytest.approx(frontal_deg, abs=1.0)


@pytest.mark.parametrize("tilt_deg", [-6.0, 0.0, 12.0])
def test_a_face_that_leans_back_below_has_its_angle(tilt_deg: float) -> None:
    """A board before the head, tilted about the ears' line: its lower edge comes nearer for positive angles."""
    across, up = np.meshgrid(np.linspace(-60.0, 60.0, 121), np.linspace(-30.0, 30.0, 61))
    away = np.tan(np.radians(tilt_deg)) * up - 8.0 * np.cos(np.pi * up / 60.0) ** 2  # hollow before the eyes
    vertices = np.stack([across, away, up], axis=2).reshape(-1, 3)
    marks = {f"{corner}_{side}": (sign * x, -2.0, 0.0) for side, sign in (("right", 1), ("left", -1))
             for corner, x in (("exocanthion", 42.0), ("endocanthion", 18.0))}  # fmt: skip
    assert fitting.frame_angle(body(vertices, np.zeros((0, 3), int), **marks)) == pytest.approx(tilt_deg, abs=0.5)


def test_no_rig_changes_a_measure() -> None:
    first, second = fitting_measures(visit()), fitting_measures(moved(visit(), MOVED))
    assert set(first) >= {"head_circumference", "frame_angle"}  # edges of 12 mm show no bridge
    for name, found in first.items():
        assert second[name].value == pytest.approx(found.value, rel=1e-6)
    assert 520.0 < first["head_circumference"].value < 640.0
    assert first["frame_angle"].unit == "deg"


def test_a_deviation_of_all_skin_together_is_the_tapes_by_its_turn() -> None:
    """Twice the stated deviation is twice the measure's. Errors that all go together would move a tape by 2 pi of them,
    those of far places that do not by less."""
    sure, unsure = (fitting_measures(visit(std_mm=std))["head_circumference"].std for std in (0.5, 1.0))
    assert unsure == pytest.approx(2.0 * sure, rel=0.05)
    assert 0.1 * 2.0 * np.pi < unsure < 2.0 * np.pi


def test_lengths_have_the_deviation_of_the_cameras_scale_and_angles_have_not() -> None:
    known, assumed = (fitting_measures(replace(visit(), scale_sigma=sigma)) for sigma in (0.0, 0.06))
    girth = assumed["head_circumference"]
    assert girth.std == pytest.approx(np.hypot(known["head_circumference"].std, 0.06 * girth.value))
    assert assumed["frame_angle"] == known["frame_angle"]


def test_a_head_without_a_back_has_no_circumference() -> None:
    face_only = visit()
    mesh = face_only.measured.mesh_world
    head = face_only.measured.head_from_world.apply(mesh.vertices)
    flat = np.where(head[:, 2:] < -20.0, (1.0, 1.0, 0.0), (1.0, 1.0, 1.0)) * head
    back = face_only.measured.head_from_world.inverse().apply(flat)
    cut = replace(face_only, measured=replace(face_only.measured, mesh_world=replace(mesh, vertices=back)))
    assert "head_circumference" not in fitting_measures(cut)


TABLE = """format = "eigenhead-sizes/1"
[[table]]
name = "helmet"
measure = "head_circumference"
allowance = 6.0
sizes = { S = [520, 550], M = [550, 580] }
"""


def test_probabilities_are_those_of_the_normal_table() -> None:
    table = SizeTable("helmet", "head_circumference", {"S": (520.0, 550.0), "M": (550.0, 580.0)}, 6.0)
    found = choose_size(table, 554.0, 10.0)  # 560 with the allowance: M reaches from -1 to +2 deviations
    assert found.best == "M"
    assert found.probabilities["M"] == pytest.approx(0.8186, abs=1e-4)
    assert found.probabilities["S"] == pytest.approx(0.1587, abs=1e-4)  # 4 deviations below, nothing is left
    assert found.none == pytest.approx(0.0228, abs=1e-4)
    sure = choose_size(table, 543.0, 0.0)
    assert (sure.best, sure.none) == ("S", 0.0)
    assert choose_size(table, 700.0, 1.0).none == 1.0


def test_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "sizes.toml"
    path.write_text(TABLE)
    sizes = {"S": (520.0, 550.0), "M": (550.0, 580.0)}
    assert read_size_tables(path, {"head_circumference"}) == [SizeTable("helmet", "head_circumference", sizes, 6.0)]


@pytest.mark.parametrize(("old", "new", "words"), [
    ("eigenhead-sizes/1", "eigenhead-sizes/9", "does not begin with format"),
    ("[[table]]", "[other]", "does not begin with format"),
    ("[520, 550]", "[550, 520]", r"S is not \[lower, upper\]"),
    ("[520, 550]", '["a", 550]', r"S is not \[lower, upper\]"),
    ("[520, 550]", "[520, 560]", "S and M overlap"),
    ('measure = "head_circumference"', "", "measure is missing, wrong or unknown"),
    ("allowance", "alowance", "alowance is missing, wrong or unknown"),
    ("sizes", "size", "sizes is missing, wrong or unknown"),
    ("name =", "name", r"not a TOML file of sizes .*: write lines such as format = .*, \[\[table\]\], name = "),
])  # fmt: skip
def test_a_wrong_table_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "sizes.toml"
    path.write_text(TABLE.replace(old, new) if old != "sizes" else TABLE.replace("sizes = {", "size = {"))
    with pytest.raises(InputError, match=words):
        read_size_tables(path, set())

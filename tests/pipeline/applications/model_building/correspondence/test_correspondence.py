"""Section 3.2 in parts with known answers, and the whole against the truth of the simulated scanner."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.applications.model_building.correspondence.correspondence import CylinderIndex, coordinates, points_at
from pipeline.applications.model_building.correspondence.scans import find_scans, plain_name, read_landmarks
from pipeline.applications.model_building.training.figures import Scanner, scan_head
from pipeline.geometry.registration.nonrigid import warp_by_landmarks
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.landmarks import NAMES
from pipeline.head_model.model import load_model
from rig.errors import InputError
from tests.support.landmark_files import write_landmarks


def sphere(radius: float) -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return np.array(ball.vertices), np.array(ball.faces)


def test_rays_meet_a_sphere_where_geometry_says() -> None:
    """radius(h) = sqrt(R^2 - h^2); facets of edge e lie at most e^2 / 2R inside (e = 0.14 R / 2 at 4 subdivisions)."""
    vertices, faces = sphere(80.0)
    rng = np.random.default_rng(0)
    angles, heights = rng.uniform(-np.pi, np.pi, 500), rng.uniform(-60, 60, 500)
    cast = CylinderIndex(vertices, faces).cast(angles, heights)
    off = np.sqrt(80.0**2 - heights**2) - cast
    edge = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).max()
    slope = 80.0 / np.sqrt(80.0**2 - 60.0**2)  # a radial miss is longer where the surface leans
    assert off.min() > -1e-6
    assert off.max() < slope * edge**2 / (2 * 80.0)
    assert np.isnan(CylinderIndex(vertices, faces).cast(np.zeros(1), np.array([200.0]))).all()


def test_the_wanted_layer_is_found() -> None:
    """Two shells, one inside the other: the outermost without a hint, the nearest with one."""
    outer, faces = sphere(80.0)
    both = np.concatenate([outer, outer / 2])
    index = CylinderIndex(both, np.concatenate([faces, faces + len(outer)]))
    angle, height = np.array([0.3]), np.array([5.0])
    assert index.cast(angle, height)[0] == pytest.approx(80, abs=1)
    assert index.cast(angle, height, np.array([45.0]))[0] == pytest.approx(40, abs=1)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-200, 200)] * 3))
def test_cylinder_coordinates_round_trip(point: tuple[float, float, float]) -> None:
    given_point = np.array([point])
    np.testing.assert_allclose(points_at(*coordinates(given_point)), given_point, atol=1e-9)


def test_warp_meets_landmarks_and_keeps_affine_motions() -> None:
    rng = np.random.default_rng(2)
    source, points = rng.normal(0, 50, (26, 3)), rng.normal(0, 80, (200, 3))
    target = source + rng.normal(0, 5, (26, 3))
    np.testing.assert_allclose(warp_by_landmarks(source, target, source), target, atol=1e-6)
    matrix, shift = np.eye(3) + rng.normal(0, 0.1, (3, 3)), rng.normal(0, 10, 3)
    np.testing.assert_allclose(
        warp_by_landmarks(source, source @ matrix + shift, points, smoothing=3.0), points @ matrix + shift, atol=1e-6
    )


def test_scans_are_raw_and_true() -> None:
    """No noise: samples lie on the head. Own vertex counts, holes at the ears, windings outward."""
    model = load_model()
    faces, head = model.levels["full"].faces, model.vertices(np.zeros(0))
    scanner = Scanner(noise_mm=0, landmark_noise_mm=0, turn_rad=0, shift_mm=0, spacing_mm=2.5)
    scans = [scan_head("s", head, faces, model.landmarks, scanner, np.random.default_rng(seed)) for seed in (0, 1)]
    assert len(scans[0].vertices) != len(scans[1].vertices)
    some = np.random.default_rng(0).choice(len(scans[0].vertices), 500, replace=False)
    assert SurfaceIndex(head, faces).closest(scans[0].vertices[some]).distances.max() < 1e-6
    v, f = scans[0].vertices, scans[0].faces
    normals = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    outward = (normals * (v[f].mean(1) * [1, 0, 1])).sum(1) > 0
    assert outward.mean() > 0.9
    behind_ear = head[model.landmarks["tragion_left"]] + [0, 0, -18.0]
    assert np.linalg.norm(v - behind_ear, axis=1).min() > 7.0
    for name in NAMES:
        np.testing.assert_allclose(scans[0].landmarks[name], head[model.landmarks[name]])


def test_landmark_files_in_every_form(tmp_path: Path) -> None:
    point = [1.5, -2.0, 80.25]
    write_landmarks(tmp_path / "a.json", {"pronasale": np.array(point)})
    (tmp_path / "b.pp").write_text(
        '<!DOCTYPE PickedPoints><PickedPoints><point x="1.5" y="-2" z="80.25" name="Pronasale" active="1"/>'
        '<point x="0" y="0" z="0" name="gnathion" active="0"/></PickedPoints>'
    )
    label = [{"label": "pronasale", "mask": [0]}, {"label": "all", "mask": [0, 1]}]
    landmarks = {"points": [point, [0, 0, 0]], "connectivity": []}
    (tmp_path / "c.ljson").write_text(json.dumps({"version": 2, "labels": label, "landmarks": landmarks}))
    three = {"version": 3, "groups": {"face": {"labels": label, "landmarks": landmarks}}}
    (tmp_path / "d.ljson").write_text(json.dumps(three))
    one = {"version": 1, "groups": [{"label": "pronasale", "landmarks": [{"point": point}]}]}
    (tmp_path / "e.ljson").write_text(json.dumps(one))
    marked = {"coordinateSystem": "RAS", "controlPoints": [{"label": "Pronasale", "position": [-1.5, 2.0, 80.25]}]}
    (tmp_path / "g.mrk.json").write_text(json.dumps({"markups": [marked]}))  # 3D Slicer's; scans are LPS
    for name in ("a.json", "b.pp", "c.ljson", "d.ljson", "e.ljson", "g.mrk.json"):
        got = read_landmarks(tmp_path / name)
        assert set(got) == {"pronasale"}, name
        np.testing.assert_allclose(got["pronasale"], point)
    (tmp_path / "f.json").write_text('\ufeff{"PRONASALE": [1.5, -2, 80.25]}', encoding="utf-8")  # as Windows saves it
    np.testing.assert_allclose(read_landmarks(tmp_path / "f.json")["pronasale"], point)
    assert plain_name(" Exocanthion-Left ") == "exocanthion_left"


def test_unreadable_landmarks_and_empty_folders_are_named(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text('{"points": {"pronasale": [1, 2]}}')
    with pytest.raises(InputError, match="pronasale"):
        read_landmarks(tmp_path / "bad.json")
    (tmp_path / "foreign.json").write_text('{"points": {"nose_tip": [1, 2, 3]}}')
    with pytest.raises(InputError, match=r"names none of the 26 landmarks .* but nose_tip"):
        read_landmarks(tmp_path / "foreign.json")
    (tmp_path / "broken.pp").write_text("<PickedPoints>")
    with pytest.raises(InputError, match=r"broken\.pp"):
        read_landmarks(tmp_path / "broken.pp")
    with pytest.raises(InputError, match=r"no \.ply"):
        find_scans(tmp_path)
    for name in ("twice.ply", "twice.obj", "once.glb"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="more than one scan called twice"):
        find_scans(tmp_path)

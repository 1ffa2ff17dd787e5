"""A head in a patient's axes, read back as 3D Slicer reads meshes and point lists."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.applications.clinic.anatomical_frame import AnatomicalFrame, frankfurt_axes, head_axes
from pipeline.applications.clinic.patient_files import marked_points, write_patient_files
from rig.errors import InputError
from rig.formats.meshes.markups import AXES, Axes, MarkupPoint, markups_document, read_markups
from tests.support.measured_heads import marks
from tests.support.visits import MOVED, moved, visit

HERE = visit()


def frame_of(plane: str, axes: Axes) -> AnatomicalFrame:
    return frankfurt_axes(HERE.measured, axes) if plane == "frankfurt" else head_axes(HERE.measured, axes)


def vertices_of(path: Path) -> np.ndarray:
    mesh = trimesh.load(path, process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return np.asarray(mesh.vertices)


def slicer_ras(folder: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Mesh and points in Slicer's scene, which is RAS: of a mesh the comment SPACE decides, of a list its own field
    (vtkMRMLModelStorageNode, vtkMRMLMarkupsJsonStorageNode); LPS differs by the signs of x and y."""
    head = folder / "head.ply"
    space = re.search(rb"comment .*SPACE=(\w+)", head.read_bytes()[:500])
    assert space is not None
    signs = {"RAS": (1.0, 1.0, 1.0), "LPS": (-1.0, -1.0, 1.0)}
    vertices = vertices_of(head) * signs[space[1].decode()]
    [markup] = json.loads((folder / "landmarks.mrk.json").read_text())["markups"]
    sign = np.array(signs[markup["coordinateSystem"]])
    return vertices, {point["label"]: sign * point["position"] for point in markup["controlPoints"]}


@pytest.mark.parametrize("plane", ["head", "frankfurt"])
@pytest.mark.parametrize("axes", AXES)
def test_slicer_sees_the_nose_in_front_and_the_left_ear_on_the_left(tmp_path: Path, axes: Axes, plane: str) -> None:
    write_patient_files(tmp_path, HERE, frame_of(plane, axes))
    vertices, points = slicer_ras(tmp_path)
    assert points["pronasale"][1] == pytest.approx(vertices[:, 1].max(), abs=0.5)  # anterior is positive
    assert points["tragion_left"][0] < -50.0  # RAS: right is positive
    assert points["tragion_right"][0] > 50.0
    assert points["glabella"][2] > points["gnathion"][2] + 80.0
    away = np.linalg.norm(vertices - points["cheilion_left"], axis=1)
    assert away.min() < 1e-3  # mesh and points lie over each other


def test_both_axes_are_one_place_in_slicer(tmp_path: Path) -> None:
    scenes = []
    for axes in AXES:
        write_patient_files(tmp_path / axes, HERE, frame_of("frankfurt", axes))
        scenes.append(slicer_ras(tmp_path / axes))
    np.testing.assert_allclose(scenes[0][0], scenes[1][0], atol=1e-4)
    for name, point in scenes[0][1].items():
        np.testing.assert_allclose(point, scenes[1][1][name], atol=1e-9)


def test_what_a_head_lacks_for_the_plane_is_named_unless_it_is_marked() -> None:
    ears = {name: place for name, place in HERE.measured.landmarks.items() if name != "tragion_left"}
    head = replace(HERE.measured, landmarks=ears)
    with pytest.raises(InputError, match=r"lacks the landmarks tragion_left$"):
        frankfurt_axes(head, "LPS")
    marked = {"porion_left": HERE.measured.landmarks["tragion_left"]}
    assert frankfurt_axes(head, "LPS", marked).sources["porion_left"] == "marked"


def test_the_frankfurt_plane_holds_its_four_points() -> None:
    frame = frankfurt_axes(HERE.measured, "LPS")
    ears = [frame.patient_from_world.apply(HERE.measured.landmarks[f"tragion_{side}"]) for side in ("right", "left")]
    np.testing.assert_allclose([ear[1:] for ear in ears], 0.0, atol=1e-9)
    np.testing.assert_allclose(ears[0] + ears[1], 0.0, atol=1e-9)
    below = [
        frame.patient_from_world.apply(HERE.measured.landmarks[f"{corner}_{side}"])
        for corner in ("exocanthion", "endocanthion")
        for side in ("right", "left")
    ]
    height = np.mean([point[2] for point in below])
    assert height == pytest.approx(18.0, abs=0.4)  # the orbitale is straight below in a frame that is tilted by degrees
    assert frame.tilt_deg is not None
    assert set(frame.sources.values()) == {"tragion", "18 mm below the middle of the eye's corners"}


def test_marked_points_take_the_place_of_substitutes(tmp_path: Path) -> None:
    """Orbitalia that are marked 6 mm lower tilt the plane by the angle that a drawing on paper gives."""
    before = head_axes(HERE.measured, "LPS").patient_from_world
    ears = {f"porion_{side}": before.apply(HERE.measured.landmarks[f"tragion_{side}"]) for side in ("right", "left")}
    middle = 0.5 * (ears["porion_right"] + ears["porion_left"])
    orbits = {f"orbitale_{side}": middle + (sign * 30.0, -75.0, -6.0) for side, sign in (("right", -1), ("left", 1))}
    points = {name.replace("_", " ").title(): MarkupPoint(point) for name, point in (ears | orbits).items()}
    path = tmp_path / "marked.mrk.json"
    path.write_text(json.dumps(markups_document(points, "LPS")))
    frame = frankfurt_axes(HERE.measured, "RAS", marked_points(path, HERE, "RAS"))
    assert set(frame.sources.values()) == {"marked"}
    assert frame.tilt_std_deg == 0.0
    assert frame.tilt_deg == pytest.approx(np.degrees(np.arctan2(6.0, 75.0)), abs=0.1)  # ears are 0.1 mm uneven


def test_a_moved_rig_gives_the_same_patient(tmp_path: Path) -> None:
    write_patient_files(tmp_path / "a", HERE, frame_of("frankfurt", "LPS"))
    there = moved(HERE, MOVED)
    write_patient_files(tmp_path / "b", there, frankfurt_axes(there.measured, "LPS"))
    first, second = (vertices_of(tmp_path / name / "head.ply") for name in "ab")
    np.testing.assert_allclose(first, second, atol=2e-4)
    frame = json.loads((tmp_path / "b" / "frame.json").read_text())
    matrix = np.array(frame["patient_from_world"])
    world = np.append(there.measured.landmarks["pronasale"], 1.0)
    nose = json.loads((tmp_path / "b" / "landmarks.mrk.json").read_text())["markups"][0]["controlPoints"]
    [stated] = [point["position"] for point in nose if point["label"] == "pronasale"]
    np.testing.assert_allclose((matrix @ world)[:3], stated, atol=1e-9)


def test_points_where_no_head_has_them_are_refused() -> None:
    behind = {f"orbitale_{side}": HERE.measured.head_from_world.inverse().apply(
        marks()[f"tragion_{side}"] - (0.0, 0.0, 80.0)) for side in ("right", "left")}  # fmt: skip
    with pytest.raises(InputError, match="no Frankfurt plane"):
        frankfurt_axes(HERE.measured, "LPS", behind)


@pytest.mark.parametrize("text", ["", "[]", '{"markups": []}', '{"markups": [{"controlPoints": [{"label": "a"}]}]}',
    '{"markups": [{"coordinateSystem": "XYZ", "controlPoints": [{"label": "a", "position": [0, 0, 0]}]}]}',
    '{"markups": [{"controlPoints": [{"label": "a", "position": [0, 0, 1e999]}]}]}'])  # fmt: skip
def test_what_is_no_point_list_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "points.mrk.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"cannot be read as a point list|no point with a position|not finite"):
        read_markups(path, "LPS")


def test_points_that_are_not_placed_are_left_out(tmp_path: Path) -> None:
    document = markups_document({"a": MarkupPoint(np.ones(3)), "b": MarkupPoint(np.zeros(3))}, "RAS")
    document["markups"][0]["controlPoints"][1]["positionStatus"] = "undefined"
    path = tmp_path / "points.mrk.json"
    path.write_text(json.dumps(document))
    found = read_markups(path, "LPS")
    assert list(found) == ["a"]
    np.testing.assert_array_equal(found["a"], (-1.0, -1.0, 1.0))

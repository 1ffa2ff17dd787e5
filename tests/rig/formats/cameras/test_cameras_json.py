"""cameras.json: what is written is read back; every fault and every key that nobody reads is named; the rig knows
its centre and its front."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.camera import Camera, Distortion, Intrinsics
from rig.errors import InputError
from rig.formats.cameras.cameras_file import unread_keys_of
from rig.formats.cameras.cameras_json import FORMAT, document_from_rig, read_rig, rig_from_document, write_rig
from rig.geometry import RigidTransform, look_at, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout

CENTRE = np.array([30.0, -20.0, 50.0])


def fan(turn: RigidTransform | None = None) -> Rig:
    """Eleven cameras from -75 to 75 degrees around CENTRE; ``turn`` puts the whole rig into another world frame."""
    cameras = []
    for i, angle in enumerate(np.radians(np.linspace(-75, 75, 11))):
        place = CENTRE + 1000.0 * np.array([np.sin(angle), 0.2 * (-1) ** i, np.cos(angle)])
        pose = look_at(place, CENTRE, np.array([0.0, 1.0, 0.0]))
        pose = pose if turn is None else pose @ turn.inverse()
        lens = Distortion(-0.1 - 0.001 * i, 0.03, 1e-4, -2e-4, 0.002)
        covariance = 1e-6 * np.diag([1.0, 1, 1, 1e4, 1e4, 2e4]) if i % 2 else None
        intrinsics = Intrinsics(1024 + i, 768, 1500.0 + i, 1501.5, 510.25, 384.75, lens)
        cameras.append(Camera(f"cam{i:02}", intrinsics, pose, covariance))
    return Rig(tuple(cameras))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    rig = fan()
    write_rig(replace(rig, scale_sigma=0.06), tmp_path / "cameras.json")
    again = read_rig(tmp_path / "cameras.json")
    assert again.subset(["cam01"]).scaled(0.5).scale_sigma == 0.06
    assert again.names == rig.names
    for one, other in zip(rig, again, strict=True):
        assert one.intrinsics == other.intrinsics
        # the reader turns every matrix into the nearest rotation: rounding only
        np.testing.assert_allclose(one.camera_from_world.rotation, other.camera_from_world.rotation, atol=1e-14)
        np.testing.assert_array_equal(one.camera_from_world.translation, other.camera_from_world.translation)
        assert (one.covariance is None) == (other.covariance is None)
    np.testing.assert_array_equal(rig["cam01"].covariance, again["cam01"].covariance)


def test_the_contract_s_example_is_read() -> None:
    entry = {
        "name": "cam00", "width": 1024, "height": 768,
        "intrinsics": {"fx": 1500.0, "fy": 1500.0, "cx": 511.5, "cy": 383.5},
        "distortion": {"model": "brown-conrady", "k1": 0, "k2": 0, "p1": 0, "p2": 0, "k3": 0},
        "camera_from_world": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 1200]},
    }  # fmt: skip
    entries = [entry | {"name": name} for name in ("cam00", "a.b-c_d", "7")]
    del entries[1]["distortion"]  # it may be absent
    rig = rig_from_document({"format": "eigenhead-cameras/1", "unit": "mm", "cameras": entries})
    np.testing.assert_array_equal(rig["cam00"].project(np.zeros((1, 3))), [[511.5, 383.5]])
    assert rig["a.b-c_d"].intrinsics.distortion.is_zero


def fault(path: str, value: Any) -> Any:
    """A document with one value changed (deleted if ``...``), as a test case that bears its name."""
    document = copy.deepcopy(document_from_rig(fan()))
    place: Any = document
    keys = [int(key) if key.isdigit() else key for key in path.split(".")]
    for key in keys[:-1]:
        place = place[key]
    if value is ...:
        del place[keys[-1]]
    else:
        place[keys[-1]] = value
    return document


NAN, INF = float("nan"), float("inf")
MIRROR = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("format", "eigenhead-cameras/9", "format is 'eigenhead-cameras/9'"),
        ("format", ..., "format is None"),
        ("unit", "m", "unit is 'm', expected 'mm'"),
        ("unit", "m", "multiply the translations by 1000 and write 'mm'"),
        ("unit", "cm", "multiply the translations by 10 and write 'mm'"),
        ("unit", "Inch", "multiply the translations by 25.4 and write 'mm'"),
        pytest.param("unit", "x" * 100_000, "unit is", id="a unit of any length"),
        pytest.param("format", "x" * 100_000, "format is", id="a format of any length"),
        ("cameras.3", "camera", "cameras[3] is no object"),
        ("cameras.3.name", ..., "cameras[3].name: None is not a name"),
        ("cameras.3.name", "../etc", "becomes the name of files"),
        ("cameras.3.name", ".hidden", "without a dot in front"),
        ("cameras.3.name", "cam\u202e3", "becomes the name of files"),
        ("cameras.3.name", "x" * 65, "is not a name of 1 to 64 characters"),
        ("cameras.3.name", "cam04", "camera 'cam04' occurs 2 times"),
        ("cameras.3.width", 0, "cam03.width is 0"),
        ("cameras.3.width", 1e9, "cam03.width is 1000000000.0"),
        ("cameras.3.height", 767.5, "cam03.height is 767.5"),
        ("cameras.3.height", True, "cam03.height is True"),
        ("cameras.3.height", NAN, "cam03.height is nan"),
        ("cameras.3.height", INF, "cam03.height is inf"),
        ("scale_sigma", 1.5, "scale_sigma is 1.5, wanted a share from 0 to 1"),
        ("cameras.3.intrinsics", ..., "cam03.intrinsics is missing or no object: wanted are fx, fy, cx, cy by name"),
        ("cameras.3.intrinsics.fx", NAN, "cam03.intrinsics.fx is nan"),
        ("cameras.3.intrinsics.fx", "1500", "cam03.intrinsics.fx is '1500'"),
        ("cameras.3.intrinsics.fy", -1500.0, "cam03.intrinsics: fx and fy must be positive"),
        ("cameras.3.intrinsics.cx", 10**400, "cam03.intrinsics.cx is 1000"),
        ("cameras.3.intrinsics.cy", ..., "cam03.intrinsics.cy is None"),
        ("cameras.3.distortion", [0, 0], "cam03.distortion is missing or no object: wanted are k1, k2, p1, p2, k3"),
        ("cameras.3.distortion.model", "fisheye", "cam03.distortion.model is 'fisheye'"),
        ("cameras.3.distortion.k1", None, "cam03.distortion.k1 is None"),
        ("cameras.3.camera_from_world.rotation", MIRROR, "a mirrored frame"),
        ("cameras.3.camera_from_world.rotation", [[2, 0, 0], [0, 2, 0], [0, 0, 2]], "is not orthonormal"),
        ("cameras.3.camera_from_world.rotation", [[1, 0], [0, 1]], "not 3 x 3 numbers"),
        ("cameras.3.camera_from_world.rotation", [0.1, 0.2, 0.3], "for a rotation vector, write the matrix"),
        ("cameras.3.camera_from_world.rotation", [[0.1], [0.2], [0.3]], "for a rotation vector, write the matrix"),
        ("cameras.3.camera_from_world.rotation", [[NAN] * 3] * 3, "rotation contains a value that is not"),
        ("cameras.3.camera_from_world.translation", [0, NAN, 0], "translation contains a value that is not"),
        ("cameras.3.camera_from_world.translation", [0, 10**400, 0], "translation contains a value that is not"),
        ("cameras.3.camera_from_world.translation", "here", "translation is missing or not 3 numbers"),
        ("cameras.3.covariance", np.eye(5).tolist(), "covariance is missing or not 6 x 6"),
        ("cameras.3.covariance", (-np.eye(6)).tolist(), "not symmetric and positive semi-definite"),
        ("cameras.3.covariance", np.triu(np.ones((6, 6))).tolist(), "not symmetric and positive semi-definite"),
    ],
)
def test_a_fault_is_named(path: str, value: Any, words: str) -> None:
    with pytest.raises(InputError) as caught:
        rig_from_document(fault(path, value))
    assert len(caught.value.faults) == 1
    assert words in caught.value.faults[0].text
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("count", [0, 2, 1025])
def test_files_hold_three_cameras_to_a_thousand(count: int) -> None:
    entries = [document_from_rig(fan())["cameras"][0] | {"name": f"c{i}"} for i in range(count)]
    with pytest.raises(InputError, match=f"{count} cameras; expected 3 to"):
        rig_from_document({"format": "eigenhead-cameras/1", "cameras": entries})


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"cameras": {}}', "[" * 100_000, '{"cameras": 1e999}'])
def test_no_text_escapes_as_another_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text(text)
    with pytest.raises(InputError):
        read_rig(tmp_path / "cameras.json")


def test_bytes_that_are_no_text_and_a_missing_file(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_bytes(b"\xff\xfe\x00")
    for name, words in (("cameras.json", "cannot be read as JSON"), ("absent.json", "No such file")):
        with pytest.raises(InputError, match=words):
            read_rig(tmp_path / name)


@pytest.mark.parametrize("turn", [np.zeros(3), np.array([np.pi, 0.0, 0.0]), np.array([0.5, -2.0, 1.0])])
def test_centre_and_front_do_not_lean_on_the_world_s_axes(turn: np.ndarray) -> None:
    world_from_world = RigidTransform(rotation_from_vector(turn), np.array([100.0, 2000.0, -300.0]))
    rig = fan(world_from_world)
    np.testing.assert_allclose(rig.centre_world(), world_from_world.apply(CENTRE), atol=1e-5)
    assert rig.front_camera() == "cam05"


def test_what_is_wrong_in_every_camera_is_said_once() -> None:
    document = json.loads(json.dumps(document_from_rig(fan())))
    for camera in document["cameras"]:
        camera["camera_from_world"]["rotation"] = [0.1, 0.2, 0.3]
    with pytest.raises(InputError) as caught:
        rig_from_document(document)
    (fault,) = caught.value.faults
    assert "write the matrix (cv2.Rodrigues); the same is true of 10 more (cam01, " in str(fault)


@pytest.mark.parametrize(
    ("place", "key"),
    [((), "units"), (("cameras",), "covarianse"), (("cameras", "intrinsics"), "skew"),
     (("cameras", "distortion"), "k4"), (("cameras", "camera_from_world"), "scale")],
)  # fmt: skip
def test_a_key_that_is_not_read_is_named_with_its_place(place: tuple[str, ...], key: str) -> None:
    document = json.loads(json.dumps(document_from_rig(default_layout())))
    entry = document
    for part in place:
        entry = entry[part][3] if part == "cameras" else entry[part]
    entry[key] = 1.0
    (remark,) = unread_keys_of(document)
    assert f"the key {'.'.join((*place, key))!r} is not read" in remark.text


def test_what_all_cameras_have_alike_is_said_once_and_a_thousand_keys_are_a_few_lines() -> None:
    document = json.loads(json.dumps(document_from_rig(default_layout())))
    for camera in document["cameras"]:
        camera["owner"] = "x"
    (remark,) = unread_keys_of(document)
    assert f"'cameras.owner' of {len(document['cameras'])} cameras" in remark.text
    assert len(unread_keys_of({"format": FORMAT} | {f"key{i}": 0 for i in range(1000)})) == 9


@pytest.mark.parametrize("key", ["\ud800", "\x1b[31m", "\a", "a" * 1000])
def test_a_key_of_any_signs_can_be_printed(key: str) -> None:
    (remark,) = unread_keys_of({"format": FORMAT, key: 1})
    assert remark.text.isprintable()
    assert len(remark.text.encode()) < 200


def test_what_this_program_writes_is_read_whole_and_each_lens_model_has_its_own_keys() -> None:
    document = json.loads(json.dumps(document_from_rig(default_layout())))
    assert unread_keys_of(document) == ()
    document["cameras"][0]["distortion"] = {"model": "kannala-brandt", "k1": 0, "k2": 0, "k3": 0, "k4": 0}
    assert unread_keys_of(document) == ()
    document["cameras"][0]["distortion"]["p1"] = 0
    assert len(unread_keys_of(document)) == 1

"""Keys of cameras.json that nobody reads are named, once, and stop nothing."""

import json

import pytest

from rig.formats.cameras.cameras_file import unread_keys_of
from rig.formats.cameras.cameras_json import FORMAT, document_from_rig
from rig.studio.scene.layout import default_layout


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

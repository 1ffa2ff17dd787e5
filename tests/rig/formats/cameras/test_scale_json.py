"""Every fault of ``scale.json`` is named, all of a file's at once."""

import json
from pathlib import Path
from typing import Any

import pytest

from rig.errors import InputError
from rig.formats.cameras.scale_json import CameraDistance, PointDistance, TagSize, read_scale, scale_from_document

CAMERAS = ("cam00", "cam01", "cam02")
POINT = {"cam00": [10, 20.5], "cam01": [11, 21]}
OTHER = {"cam00": [10, 20.5], "cam01": [31, 21]}  # behind the first in one picture


def test_two_points_a_tag_and_a_pair_of_cameras_are_read() -> None:
    known = scale_from_document({"points": {"a": POINT, "b": OTHER}, "distance_mm": 62.0}, CAMERAS)
    assert isinstance(known, PointDistance)
    assert known.distance_mm == 62.0
    assert known.first["cam00"].tolist() == [10.0, 20.5]
    tag = scale_from_document({"tag": {"dictionary": "DICT_4X4_50", "size_mm": 40}}, CAMERAS)
    assert tag == TagSize("DICT_4X4_50", 40.0)
    pair = scale_from_document({"cameras": ["cam00", "cam02"], "distance_mm": 410}, CAMERAS)
    assert pair == CameraDistance(("cam00", "cam02"), 410.0)


@pytest.mark.parametrize(
    ("document", "faults"),
    [
        ([], ["must contain one of points, tag, cameras, but contains none"]),
        ({"tag": {}, "cameras": []}, ["contains tag, cameras"]),
        ({"points": {"a": POINT}, "distance_mm": 1}, ["two points"]),
        ({"points": {"a": POINT, "b": {"cam00": [1, 2]}}, "distance_mm": 1}, ["points.b", "two cameras or more"]),
        ({"points": {"a": POINT, "b": {"cam00": [1, 2], "cam9": [1, 2]}}, "distance_mm": 1}, ["points.b", "'cam9'"]),
        (
            {"points": {"a": {**POINT, "cam00": ["x", 1]}, "b": {**POINT, "cam01": 3}}, "distance_mm": -4},
            ["distance_mm is -4", "points.a.cam00 is ['x', 1]", "points.b.cam01 is 3"],
        ),
        ({"points": {"a": POINT, "b": POINT}, "distance_mm": 62}, ["a, b are one place in cam00, cam01"]),
        (
            {"points": {"a": {**POINT, "cam00": [1e8, 2]}, "b": {**POINT, "cam01": [3, -40]}}, "distance_mm": 62},
            ["points.a.cam00 is [100000000.0, 2], wanted [x, y] in pixels, 0 to 20000", "points.b.cam01 is [3, -40]"],
        ),
        ({"tag": {"dictionary": "DICT_9", "size_mm": "4", "side": 1}}, ["'DICT_9'", "size_mm is '4'", "tag.side"]),
        ({"tag": "DICT_4X4_50"}, ["tag: expected an object"]),
        ({"cameras": ["cam00", "cam00"], "distance_mm": 1e9}, ["distance_mm is 1000000000.0", "two cameras"]),
        ({"cameras": ["cam00", "x"], "distance_mm": float("nan")}, ["distance_mm is nan", "'x'"]),
        ({"tag": {"dictionary": "DICT_4X4_50", "size_mm": 4, "\ud800": 1}}, [r"key 'tag.\ud800' is unknown"]),
        ({"points": {"\ud800": {}, "b": {}}, "distance_mm": 4}, [r"points.\ud800: a point"]),
        ({"cameras": ["cam00", "cam01"], "distance_cm": 41}, ["distance_mm is None", "key 'distance_cm' is unknown"]),
    ],
)
def test_every_fault_is_named(document: Any, faults: list[str]) -> None:
    with pytest.raises(InputError) as refused:
        scale_from_document(document, CAMERAS)
    for fault in faults:
        assert fault in str(refused.value)


def test_a_file_that_is_no_json_is_named(tmp_path: Path) -> None:
    (tmp_path / "scale.json").write_text("{")
    with pytest.raises(InputError, match=r"scale\.json: the file cannot be read as JSON"):
        read_scale(tmp_path / "scale.json", CAMERAS)
    with pytest.raises(InputError, match="cannot be read"):
        read_scale(tmp_path / "none.json", CAMERAS)
    (tmp_path / "scale.json").write_text("\ufeff" + json.dumps({"cameras": ["cam00", "cam01"], "distance_mm": 5}))
    assert read_scale(tmp_path / "scale.json", CAMERAS) == CameraDistance(("cam00", "cam01"), 5.0)

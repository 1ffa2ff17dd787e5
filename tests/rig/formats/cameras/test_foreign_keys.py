"""A row of the table of foreign keys each: what is read changes the rig, what is refused or told is named, the rest is
without effect. The page that shows the table holds just that."""

import re
from pathlib import Path

import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.cameras.cameras_file import read_cameras
from rig.formats.cameras.foreign import OPENCV_KEYS, PATTERNS, CamerasRead, Reading, shown
from rig.formats.cameras.foreign_keys import FOREIGN_KEYS, ForeignKey, Table, Treatment, says_nothing
from rig.messages.message import Message, compose, say_once, some_of, texts_of
from tests.support.fan_rig import POINTS
from tests.support.planted_keys import PLANTS, VALUES, base

ROWS = [(kind, key) for kind, (_, table) in FOREIGN_KEYS.items() for key in table]
PAGE = Path(__file__).parents[4] / "docs" / "foreign-cameras.md"
ELSEWHERE = {("colmap", "sparse/1")}  # told by what reads the folder: tests/rig/formats/captures/test_shot_files.py
# Read, and without effect for this value or in this place: what else the row says is in the test named.
AS_IT_IS = {
    ("metashape", "group@label"): "test_a_dot_in_a_label_belongs_to_the_name_and_labels_that_repeat_take_their_groups",
    ("metashape", "camera@component_id"): "test_cameras_of_two_components_are_refused",
    ("metashape", "chunk/components"): "test_cameras_of_two_components_are_refused",
    ("metashape", "component@id"): "test_cameras_of_two_components_are_refused",
    ("metashape", "chunk/transform"): "test_a_metashape_export_projects_by_its_manual",
    ("metashape", "calibration@class"): "test_a_metashape_export_projects_by_its_manual",
    **{("nerfstudio", f"timestep_{end}"): "test_of_several_moments_one_is_read" for end in ("index", "indices")},
    ("realitycapture", "ComponentId"): "test_cameras_of_two_components_are_refused",
}


def signature(read: CamerasRead) -> tuple[object, ...]:
    lenses = [(c.name, c.intrinsics.width, c.intrinsics.height, repr(c.recorded)) for c in read.rig]
    seen = [np.round(camera.project(POINTS), 4).tolist() for camera in read.rig]
    return lenses, seen, tuple(read.left_out)


@pytest.mark.parametrize("kind", FOREIGN_KEYS)
def test_what_is_written_here_has_no_key_that_is_told(kind: str, tmp_path: Path) -> None:
    assert read_cameras(base(kind, tmp_path)).remarks == ()


@pytest.mark.parametrize(("kind", "key"), ROWS)
def test_each_key_is_treated_as_its_row_says(kind: str, key: str, tmp_path: Path) -> None:
    rule = FOREIGN_KEYS[kind][1][key]
    if (kind, key) in ELSEWHERE:
        return
    path = base(kind, tmp_path)
    before = signature(read_cameras(path))
    PLANTS[kind](path, key, VALUES.get((kind, key), 7))
    word = re.split(r"[@/\[\].]", key.replace("<name>", "cam01").rstrip("]"))[-1]
    if rule.treatment == "refused":
        with pytest.raises(InputError, match=word):
            read_cameras(path)
        return
    if rule.treatment == "read" and (kind, key) not in AS_IT_IS:
        try:
            assert signature(read_cameras(path)) != before
        except InputError:
            assert (kind, key) in VALUES or kind in ("metashape", "colmap")  # refused for what it says
        return
    read = read_cameras(path)
    assert signature(read) == before
    remarks = [remark for remark in read.remarks if word in remark.text]
    assert bool(remarks) == (rule.treatment == "told")
    assert len(read.remarks) == len(remarks)


@pytest.mark.parametrize(("kind", "key"), [(kind, "frobnicated") for kind in FOREIGN_KEYS if kind != "colmap"])
def test_a_key_that_the_table_does_not_have_is_told_once(kind: str, key: str, tmp_path: Path) -> None:
    path = base(kind, tmp_path)
    name = {"metashape": f"camera@{key}", "opencv-yaml": f"{key}_<name>", "realitycapture-csv": key}.get(kind, key)
    PLANTS[kind](path, name, 1)
    (remark,) = read_cameras(path).remarks
    assert remark.code == "unknown-key"
    assert key in remark.text


def markdown_table(table: Table) -> str:
    """The table as docs/foreign-cameras.md has it, with one row for all keys that share a description."""
    rows: dict[tuple[Treatment, str | Message], list[str]] = {}
    for key, rule in table.items():
        rows.setdefault((rule.treatment, rule.why), []).append(f"`{key}`")
    order: tuple[Treatment, ...] = ("read", "refused", "told", "nothing")
    lines = ["| key | | |", "|---|---|---|"]
    for treatment in order:
        for (kind, why), keys in rows.items():
            if kind == treatment:
                lines.append(f"| {' '.join(keys)} | {treatment} | {why} |")
    return "\n".join(lines)


def test_the_page_shows_the_table_and_names_the_files_of_cameras_that_are_not_read() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for title, table in FOREIGN_KEYS.values():
        assert f"## {title}\n\n{markdown_table(table)}\n" in text
    page = PAGE.read_text(encoding="utf-8").split("## Not read")[1]
    assert [pattern for pattern, _ in PATTERNS if f"`{pattern}`" not in page] == []
    assert [key for key in OPENCV_KEYS if key.strip("\n:").lower() not in page.lower()] == []


def test_every_value_of_these_tests_belongs_to_a_row() -> None:
    assert {*VALUES, *AS_IT_IS, *ELSEWHERE} <= {*ROWS}


NOTHING = (None, 0, "0", "0.000", [0, 0.0, [0]], {"a": 0}, "", "0 0 0", False)


@pytest.mark.parametrize("value", [*NOTHING, 1, "x", [0, 1e-9], "0 0 1", True, float("nan")])
def test_values_that_say_nothing(value: object) -> None:
    assert says_nothing(value, ForeignKey("refused", "", (0,))) is any(value is nothing for nothing in NOTHING)


TABLE = {
    "shutter": ForeignKey("refused", "calibrate without it", (0,)),
    "mask": ForeignKey("told", "masks lie in masks/"),
}


@pytest.mark.parametrize("text", ["a" * 99, "it's " * 20])
def test_a_long_value_keeps_its_quotation_marks(text: str) -> None:
    assert shown(text)[0] == shown(text)[-1]
    assert len(shown(text)) <= 42


def test_faults_that_differ_in_what_was_measured_alone_are_one_and_others_are_all_said() -> None:
    faults = ["images/cam00.png is black", "images/cam01.png is black", "images/cam02.png is 7 wide"]
    assert texts_of(say_once(faults, ["cam00", "cam01", "cam02"])) == faults
    assert texts_of(say_once(["a", "b", "c"], [])) == ["a", "b", "c"]
    names = [f"cam{i:02}" for i in range(4)]
    (sentence,) = texts_of(say_once([f"{n}: {27.5 + 0.1 * i:g} px is absurd" for i, n in enumerate(names)], names))
    assert sentence == "cam00: 27.5 px is absurd; the same is true of 3 more (cam01, cam02, cam03)"
    sizes = [f"{n} is {600 + i} x 400 pixels" for i, n in enumerate(names)]
    assert texts_of(say_once(sizes, names)) == sizes


def test_many_files_with_one_fault_are_one_sentence() -> None:
    names = [f"cam{i:02}" for i in range(11)]
    (sentence,) = texts_of(say_once([f"images/{name}.png is missing" for name in names], names))
    assert sentence == (
        "images/cam00.png is missing; the same is true of 10 more (cam01, cam02, cam03, cam04 and 6 more)"
    )
    plates = [f"background/{name}/{i:03}.png is 3 x 4 pixels" for name in names for i in range(2)]
    (sentence,) = texts_of(say_once(plates, names))
    assert "the same is true of 21 more (" in sentence
    assert say_once(["cam1 is a", "cam11 is a", "cam111 is a"], ["cam1", "cam11"])[0].text.startswith("cam1 is a")


def test_what_cameras_have_alike_is_said_once() -> None:
    reading = Reading("rig.json")
    for name in ("a", "b", "c"):
        reading.judge(TABLE, {"shutter": [0, 0.1], "mask": "m.png", "other": 1}, name)
    with pytest.raises(InputError) as refused:
        reading.finish([])
    assert tuple(texts_of(refused.value.faults)) == (
        "3 cameras (a, b, c): shutter is [0, 0.1]: calibrate without it",
        "there are 0 cameras; expected 3 to 64",
    )


def test_cameras_that_take_no_part_are_named_where_too_few_are_left() -> None:
    reading = Reading("rig.xml")
    for name in ("a", "b"):
        reading.leave_out(name, compose("left-not-aligned"))
    with pytest.raises(InputError, match=r"a, b not aligned in rig\.xml: left out"):
        reading.finish([])


def test_a_list_names_a_few() -> None:
    assert some_of(["a", "b"]) == ["a", "b"]
    assert str(some_of(list("abcdef"))) == "a, b, c, d and 2 more"

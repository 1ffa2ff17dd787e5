"""A row of the table of foreign keys each: what is read changes the rig, what is refused or told is named, the rest is
without effect. The page that shows the table holds just that."""

import re
from pathlib import Path

import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.cameras.cameras_file import read_cameras
from rig.formats.cameras.foreign import OPENCV_KEYS, PATTERNS, CamerasRead
from rig.formats.cameras.foreign_keys import FOREIGN_KEYS, ForeignKey, Table, Treatment, says_nothing
from rig.messages.message import Message
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

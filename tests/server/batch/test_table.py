"""The table: each column has its value, and docs/batch.md has each column."""

import re
from pathlib import Path

import pytest

from pipeline.head_model.landmarks import NAMES
from pipeline.head_model.model_file import expression_names
from pipeline.head_model.model_names import model_path
from rig.files import document_sha256
from server.batch.captures import BatchCapture
from server.batch.folder import Origin
from server.batch.table import (
    ORIGIN,
    QUALITY,
    WHOSE,
    Outcome,
    columns_of,
    expression_columns,
    landmark_columns,
    measurement_columns,
    row_of,
)
from tests.support.pinned_work import pinned_report
from tests.support.services import ROOT

CAPTURE = BatchCapture("monday/anna", Path("anna"), "S01", "day 1")
FROM = Origin("11" * 32, "22" * 32, "33" * 32, "0.1.0")
COLUMNS = columns_of(["jawOpen", "mouthSmileLeft"])


def test_a_head_is_a_row() -> None:
    report = pinned_report(3, {"detail": "span"})
    row = row_of(Outcome(CAPTURE, Path(), "", report, FROM), COLUMNS)
    assert list(row) == [column.name for column in COLUMNS]
    assert (row["capture"], row["subject"], row["session"], row["state"]) == ("monday/anna", "S01", "day 1", "done")
    assert (row["warnings"], row["warning_count"], row["cameras"], row["cameras_used"]) == ("view", 1, 3, 2)
    assert row["contour_rms_px"] == pytest.approx(report["cameras"]["cam00"]["contour_rms_px"])
    assert (row["input_sha256"], row["settings_sha256"]) == ("11" * 32, document_sha256({"detail": "span"}))
    assert row["nose_length_mm"] == report["measurements"]["nose_length"]["value"]
    assert row["nose_length_std_mm"] is None
    assert row["face_height_mm"] is None  # of a model without it
    assert row["gonion_left_z_mm"] == report["landmarks"]["gonion_left"]["position"][2]
    assert row["gonion_left_z_std_mm"] == report["landmarks"]["gonion_left"]["std"][2]
    assert row["expression_jawOpen"] == report["expression"][0]["weight"]
    assert (row["expression_mouthSmileLeft"], row["expression_mouthSmileLeft_std"]) == (0.0, None)
    assert row["seconds"] == 1.5


def test_each_value_is_of_its_columns_kind_and_lengths_say_their_unit() -> None:
    kinds = {"text": str, "number": float, "count": int, "flag": bool}
    row = row_of(Outcome(CAPTURE, Path(), "", pinned_report(4, {}), FROM), COLUMNS)
    for column in COLUMNS:
        value = row[column.name]
        assert value is None or type(value) is kinds[column.kind], column.name
        assert column.words
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)
    for column in columns_of(expression_names(model_path("default"))):
        assert column.name.endswith(f"_{column.unit}") or column.unit in ("", "s"), column.name


def test_the_page_documents_every_column_with_its_unit() -> None:
    text = "".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in ("batch.md", "models.md"))
    rows = dict(re.findall(r"^\| `([^`]+)` \| (.*) \|$", text, re.MULTILINE))
    documented = {column.name: f"{column.unit or '-'} | {column.words}" for column in (*WHOSE, *QUALITY, *ORIGIN)}
    measured = measurement_columns()[::2]
    documented |= {column.name: f"{column.unit} | {column.words}" for column in measured}
    patterns = {"<measurement>_std_mm", "<landmark>_x_mm", "<landmark>_x_std_mm", "expression_<name>",
                "expression_<name>_std"}  # fmt: skip
    assert {name: words for name, words in rows.items() if name in documented} == documented
    assert patterns <= rows.keys()
    assert all(f"`{re.sub('_(right|left)$', '', name)}`" in text for name in NAMES)
    described = {re.sub(r"_[xyz]_", "_x_", column.name) for column in landmark_columns()}
    assert described == {f"{name}_x_{rest}" for name in NAMES for rest in ("mm", "std_mm")}
    assert [column.name for column in expression_columns(["a"])] == ["expression_a", "expression_a_std"]

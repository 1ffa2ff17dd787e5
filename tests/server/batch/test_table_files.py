"""The table as others read it: pandas' and R's way by csv and arrow."""

import builtins
import csv
import io
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

from server.batch.table import Column, Row, csv_lines, has_parquet, parquet_bytes, write_table

COLUMNS = (
    Column("capture", "text", "", "its name"),
    Column("nose_length_mm", "number", "mm", "a length"),
    Column("warning_count", "count", "", "how many"),
    Column("pose_doubtful", "flag", "", "whether"),
)
ROWS: list[Row] = [
    {"capture": 'anna, "A"\nlate', "nose_length_mm": 0.1 + 0.2, "warning_count": 3, "pose_doubtful": True},
    {"capture": "bert", "nose_length_mm": None, "warning_count": None, "pose_doubtful": None},
    {"capture": "Ä\udcff", "nose_length_mm": 1e-9, "warning_count": 0, "pose_doubtful": False},
]


def test_csv_gives_every_digit_back() -> None:
    read = list(csv.DictReader(io.StringIO(b"".join(csv_lines(COLUMNS, ROWS)).decode("utf-8"), newline="")))
    assert read[0] == {"capture": 'anna, "A"\nlate', "nose_length_mm": repr(0.1 + 0.2), "warning_count": "3",
                       "pose_doubtful": "true"}  # fmt: skip
    assert float(read[0]["nose_length_mm"]) == 0.1 + 0.2
    assert [row["nose_length_mm"] for row in read[1:]] == ["", "1e-09"]
    assert read[2]["capture"] == "Ä\\udcff"  # a file's name that is no UTF-8


def test_parquet_has_types_units_and_no_value_where_there_is_none() -> None:
    rows = [*ROWS[:2], ROWS[2] | {"capture": "Ä\\udcff"}]
    data = parquet_bytes(COLUMNS, ROWS)
    table = pyarrow.parquet.read_table(io.BytesIO(data))
    assert table.to_pylist() == rows
    assert [str(field.type) for field in table.schema] == ["string", "double", "int64", "bool"]
    assert table.schema.field("nose_length_mm").metadata == {b"unit": b"mm", b"description": b"a length"}
    assert parquet_bytes(COLUMNS, ROWS) == data


def test_without_pyarrow_there_is_the_csv_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [path.name for path in write_table(tmp_path, COLUMNS, ROWS)] == ["heads.csv", "heads.parquet"]
    real = builtins.__import__

    def without(name: str, *positional: Any, **named: Any) -> Any:
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return real(name, *positional, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    assert not has_parquet()
    assert [path.name for path in write_table(tmp_path, COLUMNS, ROWS)] == ["heads.csv"]
    assert not (tmp_path / "heads.parquet").exists()

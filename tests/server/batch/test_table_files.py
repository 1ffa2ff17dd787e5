"""The table as others read it: pandas' and R's way by csv and arrow."""

import builtins
import csv
import io
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

from pipeline.head_model.model_file import expression_names
from pipeline.head_model.model_names import model_path
from server.batch.table import Column, Row, columns_of, csv_lines, has_parquet, parquet_bytes, write_table

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


def test_every_column_of_a_heads_table_has_its_unit_and_words_in_the_schema() -> None:
    """As arrow::read_parquet of R and pandas have them: both read by the schema that is tested here."""
    columns = columns_of(expression_names(model_path("default")))
    schema = pyarrow.parquet.read_schema(io.BytesIO(parquet_bytes(columns, [])))
    assert schema.names == [column.name for column in columns]
    said = [(field.metadata[b"unit"].decode(), field.metadata[b"description"].decode()) for field in schema]
    assert said == [(column.unit, column.words) for column in columns]
    assert {str(field.type) for field in schema} == {"string", "double", "int64", "bool"}


def test_pandas_opens_both_files(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed: pip install pandas")
    write_table(tmp_path, COLUMNS, ROWS)
    parquet = pandas.read_parquet(tmp_path / "heads.parquet")
    written = pandas.read_csv(tmp_path / "heads.csv")
    for frame in (parquet, written):
        assert [*frame.columns] == [column.name for column in COLUMNS]
        assert frame["nose_length_mm"].dtype == "float64"
        assert [*frame["nose_length_mm"].dropna()] == [0.1 + 0.2, 1e-9]
        assert [*frame["warning_count"].dropna()] == [3, 0]
        assert [*frame["capture"]] == ['anna, "A"\nlate', "bert", "Ä\\udcff"]


def test_a_table_of_nothing_has_its_columns() -> None:
    assert b"".join(csv_lines(COLUMNS, [])) == b"capture,nose_length_mm,warning_count,pose_doubtful\r\n"
    assert pyarrow.parquet.read_table(io.BytesIO(parquet_bytes(COLUMNS, []))).num_columns == 4


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

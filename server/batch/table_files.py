"""Writes the table of a batch as CSV and, if pyarrow is installed, as Parquet with units."""

import csv
import io
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from rig.atomic_write import write_atomically
from rig.text import printable
from server.batch.table import Column, Row, Value

CSV, PARQUET = "heads.csv", "heads.parquet"


def write_table(folder: Path, columns: Sequence[Column], rows: Sequence[Row]) -> list[Path]:
    """Writes the table as CSV and, if pyarrow is installed, as Parquet. Returns the files. Raises OSError."""
    files = [folder / CSV]
    write_atomically(files[0], csv_bytes(columns, rows))
    if has_parquet():
        files.append(folder / PARQUET)
        write_atomically(files[1], parquet_bytes(columns, rows))
    else:
        (folder / PARQUET).unlink(missing_ok=True)  # an earlier run's would contradict the CSV
    return files


def has_parquet() -> bool:
    """Returns whether Parquet files can be written here, which needs pyarrow."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        return False
    return True


def csv_bytes(columns: Sequence[Column], rows: Sequence[Row]) -> bytes:
    """Returns the table as CSV (RFC 4180, UTF-8), with all digits of every number. A missing value is an empty cell."""
    return b"".join(csv_lines(columns, rows))


def csv_lines(columns: Sequence[Column], rows: Iterable[Row]) -> Iterator[bytes]:
    """Yields the lines of ``csv_bytes`` one by one, the names of the columns first."""
    cells = ([_cell(row[column.name]) for column in columns] for row in rows)
    for line in itertools.chain([[column.name for column in columns]], cells):
        stream = io.StringIO(newline="")
        csv.writer(stream).writerow(line)
        yield stream.getvalue().encode()


def parquet_bytes(columns: Sequence[Column], rows: Sequence[Row]) -> bytes:
    """Returns the table as a Parquet file. The metadata of each field has its unit and description. Needs pyarrow."""
    import pyarrow
    import pyarrow.parquet

    kinds = {"text": pyarrow.string(), "number": pyarrow.float64(), "count": pyarrow.int64(), "flag": pyarrow.bool_()}
    fields = [
        pyarrow.field(column.name, kinds[column.kind], metadata={"unit": column.unit, "description": column.words})
        for column in columns
    ]
    cells = [[_encodable(row[column.name]) for row in rows] for column in columns]
    arrays = [pyarrow.array(values, kinds[column.kind]) for values, column in zip(cells, columns, strict=True)]
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.table(arrays, pyarrow.schema(fields)), sink)
    return sink.getvalue().to_pybytes()


def _cell(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None else repr(value) if isinstance(value, float) else str(_encodable(value))


def _encodable(value: Value) -> Value:
    """Escapes text that UTF-8 cannot encode, since names of files need not be UTF-8."""
    return printable(value) if isinstance(value, str) else value

"""Builds the table of a batch: one row for each capture, with the columns of ``columns_of``.

The module reads results' reports and failure records and computes plain values. Lengths are mm, in the world frame;
there are no angles. A cell of the table is None if the capture lacks its value. The table is written as CSV and, if
pyarrow is installed, as Parquet with units.
"""

import csv
import io
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.evidence.measurements import DISTANCES
from pipeline.evidence.pose import PUPIL_DISTANCE
from pipeline.head_model.landmarks import NAMES
from rig.files import document_sha256, write_atomically
from rig.text import printable
from server.batch.captures import BatchCapture
from server.batch.folder import FailureRecord, Origin

Value = str | float | int | bool | None
Row = dict[str, Value]
AXES = ("x", "y", "z")
CSV, PARQUET = "heads.csv", "heads.parquet"


@dataclass(frozen=True, slots=True)
class Column:
    """Describes one column of the table. ``unit`` is empty if the column has none; ``words`` is the column's
    description in docs/batch.md."""

    name: str
    kind: Literal["text", "number", "count", "flag"]
    unit: str
    words: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """Holds the outcome of a capture: ``report`` and ``origin`` if it is done, ``failure`` if it failed, neither if the
    head is not made yet. ``link``: the address of the capture's result, for the sheet."""

    capture: BatchCapture
    result: Path
    link: str
    report: dict[str, Any] | None = None
    origin: Origin | None = None
    failure: FailureRecord | None = None


WHOSE = (
    Column("capture", "text", "", "name of the capture, and of its folder below OUT"),
    Column("subject", "text", "", "of the list; empty without one"),
    Column("session", "text", "", "of the list; empty without one"),
    Column("state", "text", "", "done, failed, or missing: not made yet"),
    Column("failure_kind", "text", "", "input, refused, crash, out-of-memory, disk-full, unwritable or bug"),
    Column("failure", "text", "", "why it failed, every fault named"),
)
QUALITY = (
    Column("quality_median_mm", "number", "mm", "median over the vertices of the posterior standard deviation"),
    Column("quality_max_mm", "number", "mm", "the largest of them"),
    Column("warnings", "text", "", "their codes, each once, with blanks between: docs/operator.md explains them"),
    Column("warning_count", "count", "", "number of warnings"),
    Column("detail", "text", "", "how deep the fit went: span, kernel, photo or fine"),
    Column("method", "text", "", "contour (fast) or simplex"),
    Column("front", "text", "", "the camera that the subject faces"),
    Column("pose_method", "text", "", "what the pose came from: landmarks, features or silhouettes"),
    Column("pose_doubtful", "flag", "", "whether the pose is in doubt"),
    Column("cameras", "count", "", "cameras of the capture"),
    Column("cameras_used", "count", "", "those whose pictures were used"),
    Column(
        "contour_rms_px", "number", "px", "distance of the outlines of input and fitted head, RMS over the used cameras"
    ),
    Column("head_scale", "number", "", "of world_from_head: the head's size beside the model's"),
)
ORIGIN = (
    Column("seconds", "number", "s", "that the reconstruction took"),
    Column("input_sha256", "text", "", "of the capture's files: what a later run compares"),
    Column("settings_sha256", "text", "", "of all settings, as head.ply names it"),
    Column("model", "text", "", "the head model's name"),
    Column("model_sha256", "text", "", "of the head model's file"),
    Column("version", "text", "", "of eigenhead that made the result"),
)


def measurement_columns() -> tuple[Column, ...]:
    """Returns two columns for each of Farkas's distances (*Anthropometry of the Head and Face*) and for the pupil
    distance: the value and its standard deviation (mm)."""
    what = {name: f"distance from {first} to {second}" for name, (first, second) in DISTANCES.items()}
    what[PUPIL_DISTANCE] = "far pupil distance; empty unless both irises are seen and look at one point"
    return tuple(
        column
        for name, meaning in what.items()
        for column in (
            Column(f"{name}_mm", "number", "mm", meaning),
            Column(f"{name}_std_mm", "number", "mm", f"standard deviation of {name}_mm"),
        )
    )


def landmark_columns() -> tuple[Column, ...]:
    """Returns six columns for each landmark: its coordinates in the world frame and their standard deviations (mm)."""
    places = (
        Column(f"{name}_{axis}_mm", "number", "mm", f"{axis} of {name}, world frame") for name in NAMES for axis in AXES
    )
    spreads = (
        Column(f"{name}_{axis}_std_mm", "number", "mm", f"standard deviation of {name}_{axis}_mm")
        for name in NAMES
        for axis in AXES
    )
    return (*places, *spreads)


def expression_columns(names: Iterable[str]) -> tuple[Column, ...]:
    """Returns two columns for each of the named expressions: its weight and the weight's standard deviation."""
    return tuple(
        column
        for name in names
        for column in (
            Column(f"expression_{name}", "number", "", f"weight of {name}, 0 to 1; 0 where the face does not make it"),
            Column(f"expression_{name}_std", "number", "", f"standard deviation of expression_{name}"),
        )
    )


def columns_of(expressions: Iterable[str]) -> tuple[Column, ...]:
    """Returns all columns in their order. ``expressions``: names of the expressions of the models in use."""
    shown = expression_columns(expressions)
    return (*WHOSE, *QUALITY, *measurement_columns(), *shown, *ORIGIN, *landmark_columns())


def row_of(outcome: Outcome, columns: Sequence[Column]) -> Row:
    """Returns the table's row of a capture. ``columns``: all columns of the table."""
    capture, report, origin, failure = outcome.capture, outcome.report, outcome.origin, outcome.failure
    said: Row = {"capture": capture.name, "subject": capture.subject or None, "session": capture.session or None}
    said["state"] = "missing"
    if report is not None and origin is not None:
        said |= {"state": "done"} | _of_report(report) | _expression(report, columns)
        said |= {"input_sha256": origin.input_sha256, "settings_sha256": document_sha256(report["settings"])}
    elif failure is not None:
        said |= {"state": "failed", "failure_kind": failure.kind, "failure": failure.message.text}
    return {column.name: said.get(column.name) for column in columns}


def _of_report(report: Mapping[str, Any]) -> Row:
    cameras = report["cameras"].values()
    row: Row = {
        "quality_median_mm": report["quality"]["median"],
        "quality_max_mm": report["quality"]["max"],
        "warnings": " ".join(dict.fromkeys(warning["code"] for warning in report["warnings"])),
        "warning_count": len(report["warnings"]),
        "detail": report["detail"]["level"],
        "method": report["method"],
        "front": report["front"],
        "pose_method": report["pose"]["method"],
        "pose_doubtful": report["pose"]["doubtful"],
        "cameras": len(report["cameras"]),
        "cameras_used": sum(camera["used"] for camera in cameras),
        "contour_rms_px": _rms([camera["contour_rms_px"] for camera in cameras if camera["used"]]),
        "head_scale": report["world_from_head"]["scale"],
        "seconds": report["seconds"]["total"],
        "model": report["model"]["name"],
        "model_sha256": report["model"]["sha256"],
        "version": report["version"],
    }
    for name, measured in report["measurements"].items():
        row |= {f"{name}_mm": measured["value"], f"{name}_std_mm": measured["std"]}
    for name, mark in report["landmarks"].items():
        for k, axis in enumerate(AXES):
            row[f"{name}_{axis}_mm"] = mark["position"][k]
            row[f"{name}_{axis}_std_mm"] = None if mark["std"] is None else mark["std"][k]
    return row


def _expression(report: Mapping[str, Any], columns: Sequence[Column]) -> Row:
    """Returns weights and standard deviations of the model's expressions. Expressions missing from the report have
    weight 0."""
    row: Row = {
        column.name: 0.0
        for column in columns
        if column.name.startswith("expression_") and not column.name.endswith("_std")
    }
    for weight in report["expression"]:
        row |= {f"expression_{weight['name']}": weight["weight"], f"expression_{weight['name']}_std": weight["std"]}
    return row


def _rms(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return (sum(value**2 for value in known) / len(known)) ** 0.5 if known else None


def write_table(folder: Path, columns: Sequence[Column], rows: Sequence[Row]) -> list[Path]:
    """Writes the table as CSV and, if pyarrow is installed, as Parquet. Returns the files. Raises OSError."""
    files = [folder / CSV]
    write_atomically(files[0], b"".join(csv_lines(columns, rows)))
    if has_parquet():
        files.append(folder / PARQUET)
        write_atomically(files[1], parquet_bytes(columns, rows))
    else:
        (folder / PARQUET).unlink(missing_ok=True)  # an earlier run's would contradict the CSV
    return files


def has_parquet() -> bool:
    """Returns whether Parquet files can be written in this installation, which needs pyarrow."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        return False
    return True


def csv_lines(columns: Sequence[Column], rows: Iterable[Row]) -> Iterator[bytes]:
    """Yields the lines of the table as CSV (RFC 4180, UTF-8), the names of the columns first, with all digits of every
    number. A missing value is an empty cell."""
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
    """Escapes text that UTF-8 cannot encode, since file names are not always UTF-8."""
    return printable(value) if isinstance(value, str) else value

"""Writes table and contact sheet of all results in a batch's folder, whichever process made them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.head_model.model_file import expression_names
from pipeline.head_model.model_names import model_path
from rig.atomic_write import write_atomically
from rig.messages.message import MessageDocument, documents_of
from server.batch.folder import BatchFolder, FailureRecord, Origin
from server.batch.plan import BatchTask
from server.batch.sheet import Card, figures_of, sheet_html, views_of
from server.batch.table import Column, Row, columns_of, row_of
from server.batch.table_files import write_table

SHEET = "sheet.html"


def write_summary(folder: BatchFolder, tasks: Sequence[BatchTask]) -> list[Path]:
    """Writes the table and the sheet of all captures of a batch, other shards' included. Returns the files.

    Raises OSError.
    """
    folder.forget_failures_but_of({task.capture.name for task in tasks})
    columns = columns_of(_expressions(tasks))
    rows, cards = [], []
    for task in tasks:
        row, card = _row_and_card(folder, task, columns)
        rows.append(row)
        cards.append(card)
    files = write_table(folder.out, columns, rows)
    write_atomically(folder.out / SHEET, sheet_html(folder.out.resolve().name, cards).encode("utf-8", "replace"))
    return [*files, folder.out / SHEET]


def _row_and_card(folder: BatchFolder, task: BatchTask, columns: Sequence[Column]) -> tuple[Row, Card]:
    name, capture = task.capture.name, task.capture
    origin, report = _result(folder, task)
    failure = None if report is not None else folder.failure(name)
    row = row_of(capture, columns, report=report, origin=origin, failure=failure)
    of = " / ".join(text for text in (capture.subject, capture.session) if text)
    picture = None if report is None else views_of(folder.result(name) / "turntable.png")
    messages = tuple(report["warnings"]) if report is not None else _why(failure)
    return row, Card(name, of, str(row["state"]), figures_of(row), messages, picture, f"{name}/")


def _result(folder: BatchFolder, task: BatchTask) -> tuple[Origin | None, dict[str, Any] | None]:
    """Returns origin and report of a capture's result if it was made with these settings and this model; otherwise
    None, None."""
    origin = folder.origin(task.capture.name)
    wanted = task.settings_sha256, task.model_sha256
    if origin is None or (origin.settings_sha256, origin.model_sha256) != wanted:
        return None, None
    try:
        return origin, folder.report(task.capture.name)
    except (OSError, ValueError):
        return None, None


def _why(failure: FailureRecord | None) -> tuple[MessageDocument, ...]:
    if failure is None:
        return ()
    return tuple(documents_of(failure.faults or (failure.message,)))


def _expressions(tasks: Sequence[BatchTask]) -> list[str]:
    """Returns the names of the expressions of all models in use, each once."""
    names = [name for model in dict.fromkeys(task.model for task in tasks) for name in _of_model(model)]
    return list(dict.fromkeys(names))


def _of_model(model: str | None) -> tuple[str, ...]:
    return expression_names(model_path(model or "default"))

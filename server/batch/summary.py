"""Writes the table and the contact sheet of all results in a batch's folder, including those of other processes."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pipeline.head_model.model_file import expression_names
from pipeline.head_model.model_names import model_path
from rig.files import write_atomically
from rig.messages.message import MessageDocument, documents_of
from server.batch.folder import BatchFolder, FailureRecord, Origin
from server.batch.plan import BatchTask
from server.batch.sheet import Card, figures_of, sheet_lines
from server.batch.table import Outcome, Row, columns_of, row_of, write_table

SHEET, SHEET_PDF = "sheet.html", "sheet.pdf"


def write_summary(folder: BatchFolder, tasks: Sequence[BatchTask]) -> list[Path]:
    """Writes the table and the sheets of all captures of a batch, including those of other parts, and returns the
    files. Each written file is replaced atomically. Raises OSError."""
    folder.forget_failures_but_of({task.capture.name for task in tasks})
    columns = columns_of(expressions_of(task.model for task in tasks))
    outcomes = [_outcome(folder, task) for task in tasks]
    rows = [row_of(outcome, columns) for outcome in outcomes]
    cards = [sheet_card(outcome, row) for outcome, row in zip(outcomes, rows, strict=True)]
    files = write_table(folder.out, columns, rows)
    from server.batch.sheet_pdf import sheet_pdf  # its library takes a while to load; the service's table does without

    title = folder.out.resolve().name
    write_atomically(folder.out / SHEET, "\n".join(sheet_lines(title, cards)).encode("utf-8", "replace"))
    write_atomically(folder.out / SHEET_PDF, sheet_pdf(title, cards))
    return [*files, folder.out / SHEET, folder.out / SHEET_PDF]


def sheet_card(outcome: Outcome, row: Row) -> Card:
    """Returns the card of the contact sheet that shows a capture. ``row``: the capture's row of the table."""
    capture, report = outcome.capture, outcome.report
    of = " / ".join(text for text in (capture.subject, capture.session) if text)
    turntable = None if report is None else outcome.result / "turntable.png"
    messages = tuple(report["warnings"]) if report is not None else _why(outcome.failure)
    return Card(capture.name, of, str(row["state"]), figures_of(row), messages, turntable, outcome.link)


def _outcome(folder: BatchFolder, task: BatchTask) -> Outcome:
    name = task.capture.name
    origin, report = _result(folder, task)
    failure = None if report is not None else folder.failure(name)
    return Outcome(task.capture, folder.result(name), f"{name}/", report, origin, failure)


def _result(folder: BatchFolder, task: BatchTask) -> tuple[Origin | None, dict[str, Any] | None]:
    """Returns origin and report of a capture's result if it was made with the task's settings and model, otherwise None
    twice."""
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


def expressions_of(models: Iterable[str | None]) -> list[str]:
    """Returns the names of all expressions that the models have, each name once. ``models`` are names or files; None
    stands for the default model. Raises UnknownModel."""
    names = [name for model in dict.fromkeys(models) for name in expression_names(model_path(model or "default"))]
    return list(dict.fromkeys(names))

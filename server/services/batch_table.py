"""Makes the table and the contact sheet of a batch of the service, with the code that ``eigenhead batch`` uses.

The module is separate because it imports the code that measures and draws heads: this import takes a second and would
delay the start of the service.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from pipeline.head_model.model_names import UnknownModel
from server.batch.captures import BatchCapture, files_sha256
from server.batch.folder import REPORT, FailureRecord, Origin
from server.batch.sheet import Card
from server.batch.summary import expressions_of, sheet_card
from server.batch.table import Column, Outcome, Row, columns_of, row_of
from server.problem_types import URN
from server.services.batches import Batches
from server.services.records import BatchOut, JobOut
from server.storage.records import CaptureRecord, SessionRecord
from server.storage.store import Store


def batch_columns(batch: BatchOut) -> tuple[Column, ...]:
    """Returns the columns of a batch's table: those of every head, and those of each expression of the batch's model.
    Columns of expressions are left out if the batch's model is no longer installed."""
    expressions: list[str] = []
    with suppress(UnknownModel):  # it was removed since
        expressions = expressions_of([batch.model])
    return columns_of(expressions)


def batch_rows(batches: Batches, store: Store, batch: BatchOut, columns: Sequence[Column]) -> Iterator[Row]:
    """Yields the rows of a batch's table, in the order of its captures. A capture that was erased, or whose head is not
    made yet, also has a row in the table."""
    return (row_of(outcome, columns) for outcome in _outcomes(batches, store, batch))


def batch_cards(batches: Batches, store: Store, batch: BatchOut) -> list[Card]:
    """Returns the cards of a batch's contact sheet, one for each capture. A card links to the console's page of the
    result."""
    columns = batch_columns(batch)
    return [sheet_card(outcome, row_of(outcome, columns)) for outcome in _outcomes(batches, store, batch)]


def _outcomes(batches: Batches, store: Store, batch: BatchOut) -> Iterator[Outcome]:
    subjects: dict[str, str] = {}
    for identity, job in batches.captures(batch.id):
        record = None if identity is None else store.found("captures", identity)
        if isinstance(record, CaptureRecord):
            capture, inputs = _capture(store, record, subjects), record.inputs
        else:
            capture, inputs = BatchCapture(identity or "", Path()), {}
        yield _outcome(store, capture, job, files_sha256(inputs))


def _capture(store: Store, record: CaptureRecord, subjects: dict[str, str]) -> BatchCapture:
    """``subjects``: names by session, as far as they were looked up."""
    session = record.session or ""
    if session and session not in subjects:
        found = store.found("sessions", session)
        subjects[session] = found.label if isinstance(found, SessionRecord) else ""
    return BatchCapture(record.id, Path(), subjects.get(session) or record.label, session)


def _outcome(store: Store, capture: BatchCapture, job: JobOut | None, input_sha256: str) -> Outcome:
    if job is None:
        return Outcome(capture, Path(), "")
    result, link = store.folder("jobs", job.id) / "result", f"/result/{job.id}"
    if job.error is not None:
        kind = job.error.type.removeprefix(URN)
        failure = FailureRecord(kind, job.error.detail, job.error.errors, None)
        return Outcome(capture, result, link, failure=failure)
    with suppress(OSError, ValueError):  # not made yet, or removed since
        report = json.loads((result / REPORT).read_bytes())
        return Outcome(capture, result, link, report, Origin(input_sha256, "", "", ""))
    return Outcome(capture, result, link)

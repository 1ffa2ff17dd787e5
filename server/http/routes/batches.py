"""Declares the routes of batches: begin, watch, pause and retry batches, and fetch the table and contact sheet of a
batch's heads."""

from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import Field

from server.http.auth import Reader, ServiceOf, Submitter
from server.http.schemas import (
    DELIVER_TO,
    EXAMPLE_ID,
    Cursor,
    DeliverTo,
    Id,
    Idempotency,
    Limit,
    Listed,
    Received,
    Sought,
    Text,
    example,
)
from server.services.answer import JobSettings
from server.services.batches import PRIORITY, BatchRequest
from server.services.records import BatchOut
from server.services.work import ReconstructionRequest
from server.storage.batches import BatchState
from server.wire.batch_files import PARQUET_TYPE, PDF_TYPE, SheetFormat, TableFormat, send_sheet, send_table
from server.wire.problems import Responses, documented

router = APIRouter(prefix="/v1", tags=["batches"])
TEXT = {"schema": {"type": "string"}}
TABLE: Responses = {200: {"content": {"text/csv": TEXT, PARQUET_TYPE: {}}}, **documented(404, 409)}
SHEET: Responses = {200: {"content": {"text/html": TEXT, PDF_TYPE: {}}}, **documented(404)}


class NewBatch(Received):
    """Requests a batch of captures, which are named in one of three ways: ``captures``, ``session`` or ``prefix``."""

    model_config = example(
        {"label": "Study 4", "prefix": "S4-", "settings": {"detail": "fine"}}, {"captures": [EXAMPLE_ID]}
    )

    captures: list[Id] | None = Field(None, min_length=1, max_length=100_000)
    session: Id | None = Field(None, description="all its captures of a head")
    prefix: Annotated[Text, Field(min_length=1)] | None = Field(
        None, description="all captures of a head whose label begins with it, in whatever case"
    )
    label: Text = Field("", description="for people; each of its jobs has it as its name")
    model: str | None = Field(None, max_length=200)
    settings: JobSettings | None = Field(None, description="of the pipeline; what is not given has its default")
    deliver_to: DeliverTo | None = Field(None, description=DELIVER_TO)
    queue: str | None = Field(None, max_length=32)
    priority: int = Field(PRIORITY, ge=1, le=1000, description="of its jobs; lower goes first, and a job has 100")


class BatchList(Listed):
    """Holds one page of batches."""

    batches: list[BatchOut]


@router.post("/batches", status_code=202, responses=documented(400, 404, 409, 413, 415, 507))
def submit_batch(
    service: ServiceOf, caller: Submitter, wanted: NewBatch, response: Response, idempotency_key: Idempotency = None
) -> BatchOut:
    """Queues a job for each of many captures, behind the jobs of other users. Repeating the request with the same
    Idempotency-Key returns the first batch."""
    request = BatchRequest(
        ReconstructionRequest(wanted.model, wanted.settings, deliver_to=wanted.deliver_to),
        wanted.captures,
        wanted.session,
        wanted.prefix,
        wanted.label,
        wanted.queue,
        wanted.priority,
    )
    batch = service.batches.submit(request, key=caller.key, idempotency_key=idempotency_key)
    response.headers["Location"] = f"/v1/batches/{batch.id}"
    return batch


@router.get("/batches", responses=documented(400))
def list_batches(
    service: ServiceOf,
    caller: Reader,
    q: Sought = "",
    *,
    state: BatchState | None = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> BatchList:
    """Lists batches in pages, newest first; ``q`` searches the label."""
    found = service.batches.page(q, state, limit, cursor)
    return BatchList(batches=list(found.items), next=found.next, total=found.total)


@router.get("/batches/{batch_id}", responses=documented(404))
def get_batch(service: ServiceOf, caller: Reader, batch_id: str) -> BatchOut:
    """Returns a batch: its state, its captures by state, and the estimated remaining seconds. ``GET /v1/jobs?batch=``
    lists a batch's jobs."""
    return service.batches.get(batch_id)


@router.post("/batches/{batch_id}/pause", responses=documented(404, 409))
def pause_batch(service: ServiceOf, caller: Submitter, batch_id: str) -> BatchOut:
    """Pauses a batch: running jobs continue, no further job begins, queued jobs are withdrawn within a second."""
    return service.batches.pause(batch_id)


@router.post("/batches/{batch_id}/resume", responses=documented(404, 409))
def resume_batch(service: ServiceOf, caller: Submitter, batch_id: str) -> BatchOut:
    """Resumes a paused batch: its captures get jobs again."""
    return service.batches.resume(batch_id)


@router.post("/batches/{batch_id}/cancel", responses=documented(404))
def cancel_batch(service: ServiceOf, caller: Submitter, batch_id: str) -> BatchOut:
    """Cancels a batch's jobs that have not ended; cancelled jobs cannot be resumed. Results stay. Cancelling has no
    effect on a batch that has ended."""
    return service.batches.cancel(batch_id)


@router.post("/batches/{batch_id}/retry", responses=documented(404, 409))
def retry_batch(service: ServiceOf, caller: Submitter, batch_id: str) -> BatchOut:
    """Queues a new job for each capture whose job failed; the failed jobs stay in the list of jobs."""
    return service.batches.retry(batch_id)


@router.delete("/batches/{batch_id}", status_code=204, responses=documented(404, 409))
def delete_batch(service: ServiceOf, caller: Submitter, batch_id: str) -> None:
    """Removes the record of a batch that has ended. The batch's jobs and heads stay."""
    service.batches.remove(batch_id)


@router.get("/batches/{batch_id}/table", responses=TABLE, response_class=StreamingResponse)
def get_batch_table(
    service: ServiceOf, caller: Reader, batch_id: str, form: Annotated[TableFormat, Query(alias="format")] = "csv"
) -> Response:
    """Returns a table with a row for each capture, in the batch's order, and the columns of ``eigenhead batch``;
    docs/batch.md describes each column with its unit."""
    return send_table(service, batch_id, form)


@router.get("/batches/{batch_id}/sheet", responses=SHEET, response_class=StreamingResponse)
def get_batch_sheet(
    service: ServiceOf, caller: Reader, batch_id: str, form: Annotated[SheetFormat, Query(alias="format")] = "html"
) -> Response:
    """Returns a batch's contact sheet: three views of each head, and the head's warnings in colour. With ``html`` the
    sheet is one self-contained file, with ``pdf`` it has A4 pages."""
    return send_sheet(service, batch_id, form)

"""Batches: many captures as one thing, how far it is, what failed; the ways to its jobs, table and sheet."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TypedDict, cast, get_args

from nicegui import ui
from starlette.responses import RedirectResponse

from rig.messages.message import Message, MessageDocument, compose, documents_of
from server.batch.table_files import has_parquet
from server.console.page import Action, Chosen, Page, shared, show
from server.console.pages.jobs import listed_jobs
from server.services.batches import BatchRequest, Selection
from server.services.job_rows import STATUSES
from server.services.records import Batch
from server.services.service import Service
from server.services.work import ReconstructionRequest
from server.storage.batches import BatchState
from server.storage.job_index import JobQuery

SHOWN = 50
FAILED_SHOWN = 20  # of the batch that is looked at; the page Jobs has all
ASKED = ("find", "state", "after")


class BatchLine(TypedDict):
    """Holds a batch as the page shows it."""

    id: str
    label: str
    state: str
    created: str
    finished: str | None
    queue: str
    priority: int
    model: str | None
    settings: dict[str, object]
    total: int
    counts: dict[str, int]
    eta_s: float | None
    notice: MessageDocument | None


class FailedJob(TypedDict):
    """Holds a job that failed, with the label of its capture and why: every fault, or the one reason."""

    id: str
    capture: str
    why: list[MessageDocument]


class BatchesState(TypedDict):
    batches: list[BatchLine]
    next: str | None
    total: int


class BatchesShown(BatchesState):
    """Holds what the page shows. ``batch``: the batch that is looked at, which may lie on another page."""

    batch: BatchLine | None
    failed: list[FailedJob]
    parquet: bool


class BatchForm(TypedDict):
    prefix: str
    label: str
    detail: str


class BatchesPage(Page, component="batches.js"):
    def look(self) -> BatchesShown:
        requested = {name: self.choice.get(name) or None for name in ASKED}
        state: BatchesState = shared.get(
            ("batches", *requested.values()), 0.5, lambda: batches_state(self.service, requested)
        )
        chosen = self.choice.get("batch")
        batch = next((one for one in state["batches"] if one["id"] == chosen), None)
        if batch is None and chosen:
            batch = next((batch_line(one) for one in self.service.batches.of([chosen])), None)
        batch = batch or next(iter(state["batches"]), None)
        failed = [] if batch is None or not batch["counts"]["failed"] else failed_jobs(self.service, batch["id"])
        parquet = shared.get("parquet", 3600.0, has_parquet)
        return {**state, "batch": batch, "failed": failed, "parquet": parquet}


def batches_state(service: Service, requested: Mapping[str, str | None]) -> BatchesState:
    """Returns one page of batches, newest first."""
    state = cast(BatchState, requested["state"]) if requested["state"] in get_args(BatchState) else None
    page = service.batches.page(requested["find"] or "", state, SHOWN, requested["after"])
    return {"batches": [batch_line(batch) for batch in page.items], "next": page.next, "total": page.total}


def batch_line(batch: Batch) -> BatchLine:
    line = asdict(batch) | {"notice": None if batch.notice is None else batch.notice.document()}
    return cast(BatchLine, line)


def failed_jobs(service: Service, batch: str) -> list[FailedJob]:
    """Returns the newest failed jobs of a batch."""

    def make() -> list[FailedJob]:
        found = service.jobs.page(JobQuery("", STATUSES["failed"], batch=batch), FAILED_SHOWN).items
        listed = listed_jobs(service, found)
        return [
            {"id": one.job.id, "capture": one.capture, "why": documents_of(error.errors or (error.detail,))}
            for one in listed
            if (error := one.job.error) is not None
        ]

    return shared.get(("failed of batch", batch), 1.0, make)


def begin(page: Page, event: BatchForm) -> Message:
    settings = {"detail": event["detail"]} if event["detail"] else {}
    wanted = BatchRequest(Selection(prefix=event["prefix"]), ReconstructionRequest(None, settings), event["label"])
    batch = page.service.batches.submit(wanted, key=page.caller.key)
    shared.forget("batches")
    page.choice["batch"] = batch.id
    return compose("batch-begun", count=batch.total)


def changes(change: Callable[[Service, str], object]) -> Callable[[Page, Chosen], None]:
    """Returns the function of an action that changes a batch."""

    def act(page: Page, event: Chosen) -> None:
        change(page.service, event["id"])
        shared.forget("batches", "failed of batch")

    return act


BatchesPage.actions = {
    "begin": Action("submit", begin),
    "pause": Action("submit", changes(lambda service, batch: service.batches.pause(batch))),
    "resume": Action("submit", changes(lambda service, batch: service.batches.resume(batch))),
    "cancel": Action("submit", changes(lambda service, batch: service.batches.cancel(batch))),
    "retry": Action("submit", changes(lambda service, batch: service.batches.retry(batch))),
    "remove": Action("submit", changes(lambda service, batch: service.batches.remove(batch))),
}


@ui.page("/batches")
async def batches_page(batch: str = "", find: str = "", state: str = "") -> RedirectResponse | None:
    return await show("batches", BatchesPage, batch=batch, find=find, state=state)

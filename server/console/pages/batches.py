"""Implements the page Batches: the progress and failures of many captures together, and links to jobs, table and
sheet."""

from collections.abc import Callable, Mapping
from typing import cast, get_args

from rig.messages.message import Message, compose, documents_of
from server.batch.table import has_parquet
from server.console.page import Action, Page, serve_page, shared
from server.console.pages.jobs import capture_of
from server.services.batches import BatchRequest
from server.services.job_rows import STATUSES
from server.services.service import Service
from server.services.work import ReconstructionRequest
from server.storage.batches import BatchState
from server.storage.job_index import JobQuery
from server.storage.records import JsonObject

SHOWN = 50
FAILED_SHOWN = 20  # of the batch that is looked at; the page Jobs has all
ASKED = ("find", "state", "after")


class BatchesPage(Page, component="batches.js"):
    """Shows the list of batches, and the selected one with its progress and failed jobs."""

    def look(self) -> JsonObject:
        """Returns the state of the page: one page of the list, and the selected batch (even if it is on another page)
        with its newest failed jobs. ``parquet``: whether this machine can make Parquet tables."""
        requested = {name: self.choice.get(name) or None for name in ASKED}
        state: JsonObject = shared.get(
            ("batches", *requested.values()), 0.5, lambda: batches_state(self.service, requested)
        )
        chosen = self.choice.get("batch")
        batch = next((one for one in state["batches"] if one["id"] == chosen), None)
        if batch is None and chosen:
            batch = next((one.model_dump() for one in self.service.batches.of([chosen])), None)
        batch = batch or next(iter(state["batches"]), None)
        failed = [] if batch is None or not batch["counts"]["failed"] else failed_jobs(self.service, batch["id"])
        parquet = shared.get("parquet", 3600.0, has_parquet)
        return {**state, "batch": batch, "failed": failed, "parquet": parquet}


def batches_state(service: Service, requested: Mapping[str, str | None]) -> JsonObject:
    """Returns one page of the list of batches, newest first. ``total`` counts the batches on all pages."""
    state = cast(BatchState, requested["state"]) if requested["state"] in get_args(BatchState) else None
    page = service.batches.page(requested["find"] or "", state, SHOWN, requested["after"])
    return {"batches": [batch.model_dump() for batch in page.items], "next": page.next, "total": page.total}


def failed_jobs(service: Service, batch: str) -> list[JsonObject]:
    """Returns the newest ``FAILED_SHOWN`` failed jobs of a batch, each with the label of its capture and, in ``why``,
    every fault or the one reason."""

    def make() -> list[JsonObject]:
        failed = service.jobs.page(JobQuery("", STATUSES["failed"], batch=batch), FAILED_SHOWN).items
        return [
            {
                "id": job.id,
                "capture": capture_of(service, job)["capture"],
                "why": documents_of(error.errors or (error.detail,)),
            }
            for job in failed
            if (error := job.error) is not None
        ]

    return shared.get(("failed of batch", batch), 1.0, make)


def begin(page: Page, event: JsonObject) -> Message:
    """Begins a batch of the captures whose labels begin with ``prefix``, and selects it. An empty ``detail`` means the
    default level of detail. Raises what ``Batches.submit`` raises."""
    settings = {"detail": event["detail"]} if event["detail"] else {}
    wanted = BatchRequest(ReconstructionRequest(None, settings), prefix=event["prefix"], label=event["label"])
    batch = page.service.batches.submit(wanted, key=page.caller.key)
    shared.forget("batches")
    page.choice["batch"] = batch.id
    return compose("batch-begun", count=batch.total)


def changes(change: Callable[[Service, str], object]) -> Callable[[Page, JsonObject], None]:
    """Makes the function of an action that changes a batch and refreshes the lists. The function ``change`` gets the
    service and the batch's id."""

    def act(page: Page, event: JsonObject) -> None:
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


serve_page("batches", BatchesPage, choices=("batch", "find", "state"), paths=("/batches",))

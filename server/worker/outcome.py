"""Writes how a job ended: its last event, the count of failures, and messages to webhooks.

All of it may be done again, since a worker may be killed before the job engine knows that the job has ended; and it
waits for a database that is away, since a job whose end nobody wrote would seem to run.
"""

import threading
from collections.abc import Callable

import sqlalchemy as sa
import structlog
from dbos import DBOS

from server.services.job_rows import WORKFLOW, request_of
from server.services.webhooks import Webhooks
from server.storage.database import events
from server.storage.events import END, EventLog
from server.storage.job_index import engine_jobs
from server.storage.records import EventDocument, JobWebhook
from server.storage.store import Store
from server.worker.pauses import insist
from server.worker.result_files import warnings_of

SET_ASIDE = "MAX_RECOVERY_ATTEMPTS_EXCEEDED"

log = structlog.get_logger()


class Outcomes:
    """Writes the outcomes of one worker's jobs."""

    def __init__(self, engine: sa.Engine, store: Store, webhooks: Webhooks, stop: threading.Event) -> None:
        self._engine, self._store, self._webhooks, self._stop = engine, store, webhooks, stop
        self._events = EventLog(engine)

    def publish(
        self, job_id: str, state: str, webhook: JobWebhook | None = None, *, failure: str | None = None
    ) -> None:
        """Writes how a job ended, with the warnings that an operator must act on, and queues messages to the webhooks
        of the service and of the job. ``failure``: the kind of a failed job. Raises WorkerStopped."""
        warnings = warnings_of(self._store.folder("jobs", job_id) / "result" / "report.json")
        for warning in warnings:
            log.warning(warning["message"], code=warning["code"])
        moved = [warning["message"] for warning in warnings if warning["code"] == "camera-moved"]
        document: EventDocument = {"state": state, "camera_moved": moved} if moved else {"state": state}
        insist(self._stop, lambda: self._events.end(job_id, document, failure=failure))
        self._announce(job_id, state, webhook)

    def publish_set_aside(self) -> list[str]:
        """Writes the end of each job that took down as many workers as it may, which no worker lives to write. Returns
        their ids."""
        status, event = engine_jobs(self._engine).c, events.c
        ended = sa.select(event.job_id).where(
            event.job_id == status.workflow_uuid, event.seq == END, event.document.contains('"failed"')
        )
        query = sa.select(status.workflow_uuid).where(status.name == WORKFLOW, status.status == SET_ASIDE)
        with self._engine.connect() as connection:
            ids = [*connection.scalars(query.where(~ended.exists()))]
        for row in DBOS.list_workflows(workflow_ids=ids, load_output=False) if ids else []:
            request = request_of(row)
            self._events.replace_end(row.workflow_id, {"state": "failed"})
            self._announce(row.workflow_id, "failed", request.get("webhook") if request else None)
        return ids

    def _announce(self, job_id: str, state: str, webhook: JobWebhook | None) -> None:
        enqueue: Callable[..., object] = DBOS.enqueue_workflow_with_options
        insist(self._stop, lambda: self._webhooks.announce(job_id, state, enqueue, job_webhook=webhook))

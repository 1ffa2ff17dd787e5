"""Provides jobs to everybody but the worker: submit, query, cancel, restart, delete.

The job engine's row of a workflow is the only record of a job: the workflow's id is the job's, its input the request,
its status the state. Progress comes from the event log, files from the data folder.
"""

import json
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import cast

import sqlalchemy as sa
import structlog
from dbos import DBOS, DBOSClient, WorkflowStatus

from rig.errors import InputError
from rig.messages.message import Message, compose
from server.errors import Conflict, NotFound, TooMany
from server.log import log_file
from server.origins import target
from server.services.answer import State
from server.services.deliveries import Deliveries, delivery_of, destination
from server.services.failures import SERIALIZER, failure
from server.services.failures import JobFailed as JobFailed  # earlier versions pickled it as one of this module
from server.services.job_rows import (
    APPLICATION,
    DELIVERY,
    FINISHED,
    STATES,
    STATUSES,
    WORKFLOW,
    by_state,
    enqueue_options,
    moment,
    request_of,
)
from server.services.records import DeliveryOut, JobOut
from server.services.results import Results
from server.services.webhooks import messages_of
from server.services.work import ReconstructionRequest, check_kind
from server.settings import ServiceSettings
from server.storage.batches import BatchIndex, BatchRow
from server.storage.database import alive_workers, portions, workers
from server.storage.events import EventLog, JobEvent
from server.storage.job_index import JobIndex, JobQuery
from server.storage.library import Library
from server.storage.pages import Page
from server.storage.records import CaptureRecord, EventDocument, FileEntry, JobRequest
from server.storage.store import Store, StoredFile, is_id, new_id, repeatable_id

WORKER_START_S = 60.0  # a worker loads for 5 s on idle cores, for 40 s where all cores are busy

log = structlog.get_logger()


def migrate(settings: ServiceSettings) -> None:
    """Creates the job engine's own tables in the service's database, which the engine's client does not do."""
    DBOS.migrate(system_database_url=settings.url)


class JobQueries:
    """Answers queries about the jobs of one service. Methods block on the database: call them from a thread."""

    def __init__(self, settings: ServiceSettings, store: Store, engine: sa.Engine, library: Library) -> None:
        self._settings, self._store, self._engine, self._library = settings, store, engine, library
        self.events, self.index, self.batches = EventLog(engine), JobIndex(engine, WORKFLOW), BatchIndex(engine)
        self.client = DBOSClient(
            system_database_url=settings.url,
            application_name=APPLICATION,
            retry_connection_errors=False,
            serializer=SERIALIZER,
        )
        self.deliveries, self.results = Deliveries(self.client), Results(store, settings)
        self.index.complete(self._requests)
        self._began = time.monotonic()

    def close(self) -> None:
        """Closes the job engine's connections to the database."""
        self.client.destroy()

    def get(self, job_id: str) -> JobOut:
        """Returns a job with its present state. Raises NotFound."""
        return self._jobs([self._known(job_id)])[0]

    def request(self, job_id: str) -> JobRequest | None:
        """Returns the request of a job, or None if the request cannot be read. Raises NotFound."""
        return request_of(self._known(job_id))

    def state(self, job_id: str) -> State:
        """Returns the state of a job. Raises NotFound."""
        return STATES[self._known(job_id, load=False).status]

    def find(
        self, *, state: str | None = None, capture: str | None = None, session: str | None = None, limit: int = 100
    ) -> list[JobOut]:
        """Returns jobs, newest first, ``limit`` at most, of one state, capture or session if not None."""
        ids = None if capture is None and session is None else self.index.ids_of(capture, session)
        if ids == []:
            return []
        status = STATUSES[state] if state else None
        rows = self.client.list_workflows(name=WORKFLOW, workflow_ids=ids, status=status, limit=limit, sort_desc=True)
        return self._jobs(rows)

    def page(self, query: JobQuery, limit: int = 100, cursor: str | None = None) -> Page[JobOut]:
        """Returns one page of the jobs that match a query, ``limit`` at most. A word of the search that names a state
        ("failed") selects jobs in that state. Raises InputError for a cursor of another list."""
        page = self.index.page(by_state(query), limit, cursor)
        return page.of(self.of(page.items))

    def of(self, ids: Sequence[str]) -> list[JobOut]:
        """Returns the jobs with these ids, in their order; ids of no job are left out."""
        if not ids:
            return []
        known = {row.workflow_id: row for row in self.client.list_workflows(name=WORKFLOW, workflow_ids=list(ids))}
        return self._jobs([known[job_id] for job_id in ids if job_id in known])

    def counts(self) -> dict[str, int]:
        """Returns the number of jobs by state."""
        counts: dict[str, int] = {state: 0 for state in STATES.values()}
        for status, count in self.index.counts().items():
            counts[STATES[status]] += count
        return counts

    def of_captures(self, captures: Collection[str]) -> dict[str, list[tuple[str, str]]]:
        """Returns the id and state of every job of each capture, newest first."""
        found = self.index.of_captures(captures)
        return {capture: [(job, STATES[status]) for job, status in jobs] for capture, jobs in found.items()}

    def active(self, *, capture: str | None = None, key: str | None = None) -> list[str]:
        """Lists the ids of queued and running jobs, of one capture or API key if not None."""
        wanted = {k: v for k, v in {"capture": capture, "key": key}.items() if v is not None}
        rows = self.client.list_workflows(
            name=WORKFLOW, status=STATUSES["queued"] + STATUSES["running"], load_input=False, load_output=False
        )
        return [row.workflow_id for row in rows if wanted.items() <= (row.attributes or {}).items()]

    def files(self, job_id: str) -> dict[str, FileEntry]:
        """Returns size and SHA-256 of the files of a job's result, by name. Raises NotFound, and Conflict if the job
        has not succeeded or its files are gone."""
        job = self.get(job_id)
        if job.state != "succeeded":
            raise Conflict("no-result", compose("job-without-result", state=job.state))
        if job.notice is not None:
            raise Conflict("result-missing", job.notice)
        return {name: FileEntry(bytes=file.bytes, sha256=file.sha256) for name, file in job.files.items()}

    def log(self, job_id: str) -> str:
        """Returns the log that workers wrote of a job. Raises NotFound for an unknown job and for a job that has not
        begun."""
        self.state(job_id)
        try:
            return log_file(self._store.data / "jobs", job_id).read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError as error:
            raise NotFound(compose("thing-job-log"), job_id, compose("hint-not-begun")) from error

    def without_result(self) -> list[str]:
        """Lists the ids of succeeded jobs whose result is missing from the data folder, newest first."""
        if self.results.objects is not None:
            return []  # what the data folder lacks is fetched
        there = set(self._store.ids("jobs"))
        done = self.index.newest_first(STATUSES["succeeded"])
        return [job_id for job_id in done if job_id not in there or not self._result(job_id).is_dir()]

    def orphans(self) -> list[str]:
        """Lists folders of results without a job in the database: the database is another one, or was lost."""
        there = [job_id for job_id in self._store.ids("jobs") if self._result(job_id).is_dir()]
        known = {job_id for some in portions(there) for job_id in self.index.known(some)}
        return [job_id for job_id in there if job_id not in known]

    def result_file(self, job_id: str, name: str) -> StoredFile:
        """Returns a file of a job's result. The file's name is looked up in the job's record. Raises NotFound for an
        unknown job or file, and Conflict if the job has no result."""
        file = self.files(job_id).get(name)
        if file is None:
            raise NotFound(compose("thing-file"), name, compose("hint-result-files", job=job_id))
        stored = self.results.file(job_id, name, file)
        self._unless_removed(job_id)
        return stored

    def result_folder(self, job_id: str) -> Path:
        """Returns the folder with all files of a job's result. Raises NotFound and Conflict."""
        folder = self.results.folder(job_id, self.files(job_id))
        self._unless_removed(job_id)
        return folder

    def _unless_removed(self, job_id: str) -> None:
        """Raises NotFound if the job was erased while its files were fetched, and removes the fetched files."""
        if self.results.objects is not None and self._status(job_id, load=False) is None:
            self.results.erase(job_id)
            raise NotFound(compose("thing-job"), job_id)

    def _result(self, job_id: str) -> Path:
        return self._store.folder("jobs", job_id) / "result"

    def queue_notice(self, queue: str | None) -> Message | None:
        """Returns a message if no live worker serves a queue, so that its jobs cannot begin. Returns None if a live
        worker serves the queue."""
        with self._engine.connect() as connection:
            alive = alive_workers(connection, self._settings.silent_s)
            if connection.scalar(sa.select(sa.func.count()).where(alive, workers.c.queue == queue)):
                return None
        if queue == self._settings.queue and self.worker_may_start():
            return compose("worker-starting")
        return compose("no-worker", queue=f"{queue!r}", queue_name=str(queue))

    def worker_may_start(self) -> bool:
        """Returns whether the service started less than ``WORKER_START_S`` seconds ago, so that its worker may still be
        loading."""
        return time.monotonic() - self._began < WORKER_START_S

    def _requests(self, jobs: list[str]) -> dict[str, JobRequest]:
        rows = self.client.list_workflows(workflow_ids=jobs, name=WORKFLOW, load_output=False)
        return {row.workflow_id: request for row in rows if (request := request_of(row)) is not None}

    def _status(self, job_id: str, load: bool = True) -> WorkflowStatus | None:
        rows = self.client.list_workflows(workflow_ids=[job_id], name=WORKFLOW, load_input=load, load_output=load)
        return rows[0] if rows else None

    def _known(self, job_id: str, load: bool = True) -> WorkflowStatus:
        row = self._status(job_id, load) if is_id(job_id) else None
        if row is None:
            raise NotFound(compose("thing-job"), job_id)
        return row

    def _jobs(self, rows: Sequence[WorkflowStatus]) -> list[JobOut]:
        latest = self.events.latest([row.workflow_id for row in rows])
        idle = {name: self.queue_notice(name) for name in {r.queue_name for r in rows if STATES[r.status] == "queued"}}
        places = self.index.places() if idle else {}
        begun = self.deliveries.of([row.workflow_id for row in rows if STATES[row.status] == "succeeded"])
        return [self._job(row, latest.get(row.workflow_id), places, begun, idle) for row in rows]

    def _job(
        self,
        row: WorkflowStatus,
        event: JobEvent | None,
        places: Mapping[str, int],
        begun: Mapping[str, DeliveryOut],
        idle: Mapping[str | None, Message | None],
    ) -> JobOut:
        state = STATES[row.status]
        progress: EventDocument = event.document if event is not None and state == "running" else {}
        request = request_of(row)
        frames = None if request is None else request.get("frames")
        here = state == "succeeded" and self.results.objects is None
        lost = here and not self._result(row.workflow_id).is_dir()
        return JobOut(
            id=row.workflow_id,
            name="" if request is None else request.get("name", ""),
            state=state,
            stage=progress.get("stage") or ("done" if state == "succeeded" else state),
            progress=1.0 if state == "succeeded" else progress.get("progress", 0.0),
            eta_s=progress.get("eta_s"),
            frames=frames,
            frames_done=frames if state == "succeeded" else progress.get("frames_done"),
            error=failure(row) if state == "failed" else None,
            notice=idle[row.queue_name] if state == "queued" else compose("result-missing") if lost else None,
            capture_id=None if request is None else request["capture_id"],
            session=(row.attributes or {}).get("session"),
            model=None if request is None else request.get("model"),
            settings={} if request is None else dict(request.get("settings") or {}),
            restart_of=None if request is None else request.get("restart_of"),
            queue=row.queue_name,
            priority=row.priority or 0,
            ahead=places.get(row.workflow_id) if state == "queued" else None,
            created=moment(row.created_at),
            started=moment(row.dequeued_at),
            finished=moment(row.completed_at) if state in FINISHED else None,
            files=dict(row.output or {}) if state == "succeeded" else {},
            delivery=delivery_of(row.workflow_id, state, request, begun),
        )


class Jobs(JobQueries):
    """Queues, cancels, repeats and deletes jobs; its methods block on the database."""

    def submit(
        self,
        capture_id: str,
        wanted: ReconstructionRequest,
        *,
        key: str = "local",
        idempotency_key: str | None = None,
        queue: str | None = None,
        priority: int = 100,
    ) -> JobOut:
        """Queues a reconstruction of a shot, or the tracking of a film, and returns the job. A repeated request with
        the same idempotency key returns the job of the first request.

        Raises NotFound for an unknown capture; InputError for an unknown model, wrong settings or queue; InvalidInput
        for a webhook that may not be called and for a place where results may not be delivered; Conflict for a capture
        of the calibration board and for an idempotency key that was used for another request; DiskFull; TooMany if the
        API key has too many jobs.
        """
        capture = self._store.capture(capture_id)
        check_kind(capture, film=True)
        wanted.check(film=capture.frames > 0)
        self.check_queue(queue)
        self._store.reserve(0, self._settings.free_bytes)
        request: JobRequest = {"capture_id": capture_id, "model": wanted.model, "settings": wanted.settings or {}}
        if capture.frames:
            request["frames"] = capture.frames
        if wanted.name:
            request["name"] = wanted.name
        if wanted.webhook is not None:
            target(wanted.webhook["url"], self._settings.webhook_origins)
            request["webhook"] = wanted.webhook
        if wanted.deliver_to is not None:
            request["deliver_to"] = destination(wanted.deliver_to, self._settings)
        return self._enqueue(request, capture.session, key, queue, priority, idempotency_key)

    def check_queue(self, queue: str | None) -> None:
        """Raises InputError for a queue that jobs may not name. A queue of None stands for the service's own queue."""
        if queue is not None and queue not in self._settings.queues:
            raise InputError("queue", [compose("queue-unknown", queue=f"{queue!r:.40}", queues=self._settings.queues)])

    def submit_session(self, session: str, wanted: ReconstructionRequest, *, key: str, priority: int) -> list[JobOut]:
        """Queues a reconstruction of every capture of a session that shows a head, and returns the jobs. Raises what
        ``submit`` raises; jobs queued before the error stay queued."""
        wanted.check()  # a session without captures asks no job to
        self._store.session(session)
        return [self.submit(capture, wanted, key=key, priority=priority) for capture in self._library.heads_of(session)]

    def _enqueue(
        self,
        request: JobRequest,
        session: str | None,
        key: str,
        queue: str | None,
        priority: int,
        idempotency_key: str | None = None,
    ) -> JobOut:
        job_id = new_id() if idempotency_key is None else repeatable_id(key, idempotency_key)
        first = None if idempotency_key is None else self._status(job_id)
        if first is None:
            if (active := len(self.active(key=key))) >= self._settings.jobs_per_key:
                raise TooMany("too-many-jobs", compose("too-many-jobs", count=active), retry_after_s=10)
            self.index.add(job_id, request, session)
            options = enqueue_options(WORKFLOW, queue or self._settings.queue, job_id)
            options["priority"] = priority
            options["attributes"] = {"capture": request["capture_id"], "session": session, "key": key}
            self.client.enqueue(options, request)
            first = self._status(job_id)
            assert first is not None
        if not self._asks_the_same(request_of(first), request):
            raise Conflict("idempotency-conflict", compose("idempotency-key-reused"))
        return self._jobs([first])[0]

    def enqueue_within(
        self, connection: sa.Connection, request: JobRequest, session: str | None, batch: BatchRow
    ) -> str:
        """Queues a job of a batch in the caller's transaction and returns its id. If the transaction fails, no job is
        queued. A batch's job does not count towards the limit of jobs of an API key."""
        job_id = new_id()
        self.index.add_within(connection, job_id, request, session)
        options = enqueue_options(WORKFLOW, batch.queue, job_id)
        options["priority"] = batch.priority
        options["attributes"] = {"capture": request["capture_id"], "session": session, "batch": batch.id}
        self.client.enqueue_in_transaction(connection, options, request)
        return job_id

    def _asks_the_same(self, first: JobRequest | None, request: JobRequest) -> bool:
        """Returns whether two requests want the same work on the same pictures, of whatever capture."""
        if first is None or {**json.loads(json.dumps(request)), "capture_id": first["capture_id"]} != first:
            return False
        captures = [self._store.found("captures", each["capture_id"]) for each in (first, request)]
        inputs = [capture.inputs for capture in captures if isinstance(capture, CaptureRecord)]
        return first["capture_id"] == request["capture_id"] or (len(inputs) == 2 and inputs[0] == inputs[1])

    def cancel(self, job_id: str) -> tuple[JobOut, bool]:
        """Cancels a queued or running job; a finished one stays as it is. Returns the job, and whether this call
        cancelled it. A worker notices the cancellation within about a second. Raises NotFound."""
        if runs := self.state(job_id) not in FINISHED:
            self.client.cancel_workflow(job_id)
        job = self.get(job_id)
        if job.state == "cancelled":
            self.events.replace_end(job_id, {"state": "cancelled"})
        return job, runs and job.state == "cancelled"

    def restart(self, job_id: str, wanted: ReconstructionRequest, *, key: str = "local") -> JobOut:
        """Queues a new job for the capture of an earlier job, and records the earlier job's id in it. Model and
        settings that are None in ``wanted`` are the earlier job's. Raises InputError for a wrong model or settings,
        NotFound if the job or its capture is gone, and TooMany."""
        row = self._known(job_id)
        request = request_of(row)
        if request is None:
            raise NotFound(compose("thing-job-request"), job_id)
        wanted.check(film="frames" in request)
        request = cast(JobRequest, {**request, "restart_of": job_id})
        if wanted.settings is not None:
            request["settings"] = wanted.settings
        if wanted.model is not None:
            request["model"] = wanted.model
        self._store.capture(request["capture_id"])
        return self._enqueue(request, (row.attributes or {}).get("session"), key, row.queue_name, row.priority or 0)

    def delete(self, job_id: str) -> None:
        """Removes a finished job and its files. The files are removed before the job, since their removal needs no room
        in the database and can be repeated. Raises NotFound, and Conflict for a queued or running job."""
        if self.state(job_id) not in FINISHED:
            raise Conflict("job-active", compose("job-active"))
        self.deliveries.forget(job_id)
        self.results.erase(job_id)
        self.events.remove([job_id])
        self.client.delete_workflow(job_id)
        self.index.remove(job_id)

    def forget_messages(self, jobs: Collection[str]) -> None:
        """Removes messages to webhooks about jobs, with addresses and secrets, whether they were delivered or not."""
        for job_id in jobs:
            query = {"name": DELIVERY, "workflow_id_prefix": messages_of(job_id), "load_output": False}
            if rows := self.client.list_workflows(**query, load_input=False):
                self.client.delete_workflows([row.workflow_id for row in rows])

"""The worker: takes jobs from a queue, runs each in a child process, and takes over jobs of dead workers.

A job is three durable steps around one ``reconstruct()``. *Ingest* checks that the capture exists and the disk has
space. *Fit* makes the child write a complete result folder under a name of this attempt. *Publish* renames that folder.
If a worker is killed in a step, another worker repeats this step. The bytes of a result do not depend on the worker, so
it does no harm if two workers do the same step.

Every worker writes a heartbeat row. A worker that finds another dead (stopped, its process gone on the same machine, or
silent for ``silent_s``) puts its jobs back into their queue. The job engine changes only rows that still belong to the
dead worker, so several workers may put back jobs at once. One statement on the table of the job engine (DBOS) puts jobs
back before a new worker takes its first job, so an interrupted job keeps its place. The job engine's own methods do not
suffice: resume_workflow takes a job from its current worker, revives a cancelled one and forgets how many workers the
job took down; its recovery is private, and begins only after jobs are taken.
"""

import json
import os
import platform
import resource
import secrets
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Concatenate

import sqlalchemy as sa
import structlog
from dbos import DBOS, DBOSConfig, PortableWorkflowError
from dbos import error as dbos_error
from sqlalchemy.exc import SQLAlchemyError

from pipeline.settings import PHOTO_LEVELS, settings_from_document
from rig.errors import DISK_FULL, Cancelled, InputError
from rig.files import sha256_of, write_atomically
from rig.messages.message import Message, MessageDocument, compose
from rig.progress import Progress
from server.errors import UNWRITABLE, unusable_input
from server.problem_types import type_of_failure
from server.processes import process_identity, process_started
from server.services import calibrations
from server.services.deliveries import DELIVERIES_QUEUE, enqueue_delivery
from server.services.failures import SERIALIZER, JobFailed, restore_failure
from server.services.job_rows import APPLICATION, APPLICATION_VERSION, DELIVERY, WORKFLOW, request_of
from server.services.results import Results
from server.services.webhooks import WEBHOOKS_QUEUE, Webhooks
from server.settings import ServiceSettings
from server.storage.capture_blobs import open_capture_blobs
from server.storage.database import AWAY, events, now_sql, open_database, workers
from server.storage.events import END, EventLog
from server.storage.folders import move_durably
from server.storage.job_index import RUNNING, engine_jobs
from server.storage.records import EventDocument, FileEntry, JobRequest, JobWebhook, JsonObject, WebhookMessage
from server.storage.store import Store
from server.tasks.calibrate import calibrate_folder, expected, forget_scene
from server.tasks.child import ChildProcessPool, WorkerContext, WorkFailed, function_at
from server.tasks.film import CHUNKS, FilmProgress, track_film
from server.tasks.progress import EVERY_S, JobProgress, ProgressMeter
from server.tasks.reconstruct import reconstruct_capture
from server.tasks.stage_durations import StageDurations, megapixels_of
from server.worker.capture_source import CaptureSource
from server.worker.delivery import DELIVERIES_AT_ONCE, Deliverer
from server.worker.pauses import WorkerStopped, insist, pause

LOST_S = 10.0  # between the end of a workflow and its row, which takes milliseconds
FORGET_S = 3600.0  # rows of dead workers are kept so long, for the operator to see

log = structlog.get_logger()
SET_ASIDE = "MAX_RECOVERY_ATTEMPTS_EXCEEDED"


class Worker:
    """Takes jobs from one queue, which the settings name, and runs them. The job engine is a singleton, so a process
    has one worker."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.settings = settings
        self.engine = open_database(settings)
        self.store = Store(settings.data, blobs=open_capture_blobs(settings, self.engine), spare=settings.free_bytes)
        self.events = EventLog(self.engine)
        self.id = f"{platform.node()}-{os.getpid()}-{secrets.token_hex(4)}"[:64]
        self._heartbeat = Heartbeat(self.engine, settings, self.events, self.id)
        self._children = ChildProcessPool(settings.concurrency, niceness=5)  # a busy machine still answers requests
        self._work: Callable[Concatenate[WorkerContext, Progress, ...], object] = function_at(settings.work)
        self._stop = threading.Event()
        self._webhooks = Webhooks(self.engine, settings.webhook_origins)
        self._durations = StageDurations()
        self._states = _StateWatch(settings.poll_s)
        self.results = Results(self.store, settings)
        self._captures = CaptureSource(self.store, settings, self._states.runs, self._stop)
        self.outcomes = Outcomes(self.engine, self.store, self._webhooks, self._stop)
        self._deliverer = Deliverer(settings, self.store, self._webhooks, self.results, self._stop)

    def start(self) -> None:
        """Writes the first heartbeat, starts the job engine and takes jobs. Returns at once; jobs run in threads."""
        DBOS.migrate(system_database_url=self.settings.url)
        config: DBOSConfig = {
            "name": APPLICATION,
            "system_database_url": self.settings.url,
            "application_version": APPLICATION_VERSION,
            "executor_id": self.id,
            "enable_otlp": False,
            "log_level": "WARNING",
            "notification_listener_polling_interval_sec": 1.0,
            "serializer": SERIALIZER,
        }
        DBOS(config=config)
        self._register()
        self._deliverer.register()
        DBOS.listen_queues([self.settings.queue, WEBHOOKS_QUEUE, DELIVERIES_QUEUE])
        # Before the first job: nobody notices the death of a worker without a row, and an interrupted job goes first.
        self._heartbeat.beat()
        self._heartbeat.put_back()
        DBOS.launch()
        limit = self.settings.concurrency
        DBOS.register_queue(
            self.settings.queue,
            worker_concurrency=limit,
            polling_interval_sec=self.settings.poll_s,
            on_conflict="always_update",
        )
        DBOS.register_queue(WEBHOOKS_QUEUE, worker_concurrency=8, on_conflict="always_update")
        DBOS.register_queue(DELIVERIES_QUEUE, worker_concurrency=DELIVERIES_AT_ONCE, on_conflict="always_update")
        beating = (self._stop, self.outcomes)
        threading.Thread(target=self._heartbeat.keep_up, args=beating, name="heartbeat", daemon=True).start()
        threading.Thread(target=self._captures.tidy_forever, name="tidy", daemon=True).start()
        log.info("worker ready", worker=self.id, queue=self.settings.queue, concurrency=limit)

    def run_until_stopped(self) -> None:
        """Runs jobs until ``stop`` is called, then ends the process. Another worker takes over a job that is running
        then."""
        while not self._stop.wait(0.5):
            pass
        self._heartbeat.end()
        log.info("worker stopped", worker=self.id)
        os._exit(0)  # an orderly end of the engine would record a job that is cut off here as failed

    def stop(self) -> None:
        """Makes ``run_until_stopped`` end the process, within half a second."""
        self._stop.set()

    def _register(self) -> None:
        worker = self

        @DBOS.step(name="ingest")
        def ingest(job_id: str, request: JobRequest) -> None:
            insist(worker._stop, lambda: worker.ingest(job_id, request))

        @DBOS.step(name="fit")
        def fit(job_id: str, request: JobRequest) -> str:
            return worker.fit(job_id, request)

        @DBOS.step(name="publish")
        def publish(job_id: str, attempt: str) -> dict[str, FileEntry]:
            return insist(worker._stop, lambda: worker.publish(job_id, attempt))

        @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=self.settings.attempts)
        @self._heartbeat.noted()
        def reconstruct_job(request: JobRequest) -> dict[str, FileEntry]:
            job_id = DBOS.workflow_id
            assert job_id is not None
            with structlog.contextvars.bound_contextvars(job=job_id):
                try:
                    ingest(job_id, request)
                    files = publish(job_id, fit(job_id, request))
                except (JobFailed, PortableWorkflowError) as error:
                    if (failed := restore_failure(error)) is None:
                        raise
                    log.warning("job failed", kind=failed.kind, detail=failed.detail.text)
                    worker.outcomes.publish(job_id, "failed", request.get("webhook"), failure=failed.kind)
                    raise failed from error
                except (Cancelled, dbos_error.DBOSWorkflowCancelledError):
                    worker.results.discard(job_id)
                    raise
                worker.outcomes.publish(job_id, "succeeded", request.get("webhook"))
                worker._captures.leave(job_id, request["capture_id"])
                if "deliver_to" in request:
                    place, hook = request["deliver_to"], request.get("webhook")
                    enqueue_delivery(DBOS.enqueue_workflow_with_options, job_id, place, worker.settings, hook)
                return files

        @DBOS.step(name="post", retries_allowed=True, interval_seconds=2.0, backoff_rate=2.0, max_attempts=9)
        def post(message: WebhookMessage) -> int:
            return worker._webhooks.post(message)

        @DBOS.workflow(name=DELIVERY)
        @self._heartbeat.noted()
        def deliver(message: WebhookMessage) -> int:
            return post(message)

        @DBOS.step(name="calibrate")
        def calibrate(identity: str) -> JsonObject:
            return worker.calibrate(identity)

        @DBOS.workflow(name=calibrations.WORKFLOW, max_recovery_attempts=self.settings.attempts)
        @self._heartbeat.noted()
        def calibrate_rig(identity: str) -> JsonObject:
            return calibrate(identity)

        del reconstruct_job, deliver, calibrate_rig  # known to the engine by name

    def ingest(self, job_id: str, request: JobRequest) -> None:
        """Checks that a job's capture exists and that the disk has space, and makes the job's folder. Raises JobFailed
        with a clear reason for what would make the fit fail later."""
        self.events.append(job_id, {"state": "running", "stage": "ingest", "progress": 0.0, "eta_s": None})
        try:
            self.store.folder("jobs", job_id).mkdir(parents=True, exist_ok=True)  # where its log goes
        except OSError as error:
            raise failure_of(error) from error
        log.info("job started", capture=request["capture_id"])
        self._captures.check(request["capture_id"])

    def fit(self, job_id: str, request: JobRequest) -> str:
        """Reconstructs a job's capture in a child process. Returns the name of the folder with the complete result.

        Raises JobFailed for failures that a repetition would not mend, and Cancelled. After any error the attempt's
        folder is removed.
        """
        name = f"attempt-{secrets.token_hex(6)}"
        folder = self.store.folder("jobs", job_id) / name
        try:
            self._fit_in_memory(job_id, request, folder)
        except BaseException as error:
            shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error, Cancelled):
                log.info("job cancelled")  # here: the engine ends a cancelled workflow before its own handlers run
            if isinstance(failed := failure_of(error), JobFailed | Cancelled):  # no attempt follows
                shutil.rmtree(folder.with_name(CHUNKS), ignore_errors=True)
            raise failed from error
        return name

    def _fit_in_memory(self, job_id: str, request: JobRequest, folder: Path) -> None:
        """Runs a job's work, again if its child was out of memory or killed with signal 9 (as the system does if memory
        is short), and then at level photo, which report.json states. Raises the error of the last attempt."""
        settings = request.get("settings") or {}
        tries = [settings, settings]
        if settings.get("detail") in PHOTO_LEVELS and settings.get("detail") != "photo":
            tries.append({**settings, "detail": "photo"})
        for count, chosen in enumerate(tries, 1):
            folder.mkdir(parents=True)
            try:
                self._run_work(job_id, request, folder, chosen)
            except WorkFailed as error:
                if error.kind != "killed" and (error.kind != "out-of-memory" or count == len(tries)):
                    raise
                log.warning("work had too little memory", times=count, of=len(tries))
                shutil.rmtree(folder, ignore_errors=True)
            else:
                if chosen is not settings:
                    add_warning(folder / "report.json", compose("level-lowered"))
                return
        gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
        raise JobFailed("out-of-memory", compose("killed-for-memory", count=len(tries), gb=gb))

    def _run_work(self, job_id: str, request: JobRequest, folder: Path, settings: Mapping[str, object]) -> None:
        frames = request.get("frames")
        chosen = settings_from_document({} if frames else settings)
        with self._captures.files(job_id, request["capture_id"]) as files, self._children.one() as child:
            megapixels = megapixels_of(files)
            progress = FilmProgress(frames) if frames else JobProgress(self._durations.of(chosen, megapixels))
            meter = ProgressMeter(self.events, job_id, progress, max(EVERY_S, self.settings.poll_s))

            def cancelled() -> bool:
                meter.tick()  # asked many times a second, also where a stage reports nothing
                return not self._states.runs(job_id)

            meter.report("read", 0.0)  # a fresh child loads for seconds before it says so itself
            child.remote(track_film if frames else self._work, report=meter.report, cancelled=cancelled)(
                capture=str(files),
                result=str(folder),
                cache=str(self.store.cache_of(request["capture_id"])),
                model=request.get("model"),
                settings={**settings},
            )
        if self._work is reconstruct_capture and not frames:  # how long another work takes says nothing of this one
            self._durations.learn(chosen, progress.finish(), megapixels)

    def calibrate(self, identity: str) -> JsonObject:
        """Computes one calibration in a child process and returns its outcome. The result is written under a temporary
        name and renamed at the end. Pictures of a scene are removed after the calibration, and also after a failure
        that a repetition would not mend (JobFailed)."""
        folder = self.store.folder("calibrations", identity)
        in_use = self.settings.data / "rig" / "cameras.json"
        attempt = folder / f"attempt-{secrets.token_hex(6)}"
        meter = ProgressMeter(self.events, identity, JobProgress(expected(folder)), max(EVERY_S, self.settings.poll_s))

        def tick() -> bool:
            meter.tick()
            return False

        for left in folder.glob("attempt-*"):  # of a worker that was killed
            shutil.rmtree(left, ignore_errors=True)
        try:
            with self._children.one() as child:
                result = child.remote(calibrate_folder, report=meter.report, cancelled=tick)(
                    folder=str(folder),
                    result=str(attempt),
                    previous=str(in_use) if in_use.is_file() else None,
                    cache=str(self.settings.data / "cache" / "boards"),
                    front=None,
                )
            shutil.rmtree(folder / "result", ignore_errors=True)
            move_durably(attempt, folder / "result")
        except BaseException as error:
            shutil.rmtree(attempt, ignore_errors=True)
            failed = failure_of(error)
            if isinstance(failed, JobFailed):
                forget_scene(folder)
            raise failed from error
        forget_scene(folder)
        return result

    def publish(self, job_id: str, attempt: str) -> dict[str, FileEntry]:
        """Renames the folder of an attempt to ``result`` and removes what other attempts left. Returns size and SHA-256
        of every file by name.

        If another worker has published a result of the job already, that result stays; its files have the same bytes.
        """
        folder = self.store.folder("jobs", job_id)
        target = folder / "result"
        if not target.is_dir():
            try:
                move_durably(folder / attempt, target)
            except OSError as error:
                if not target.is_dir():
                    raise failure_of(error) from error
        for old in (*folder.glob("attempt-*"), folder / CHUNKS):
            shutil.rmtree(old, ignore_errors=True)
        files = described(target)
        self.results.keep(job_id, files, lambda: self._states.runs(job_id), partial(pause, self._stop))
        log.info("job finished", bytes=sum(file["bytes"] for file in files.values()))
        return files


def failure_of(error: BaseException) -> BaseException:
    """Returns the JobFailed of an error that a repetition would not mend, and any other error unchanged."""
    if isinstance(error, Cancelled):
        return error
    if isinstance(error, InputError):
        problem = unusable_input(error)
        return JobFailed(problem.kind, problem.detail, error.faults)
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return JobFailed("disk-full", compose("disk-full"))
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        return JobFailed("data-unwritable", compose("data-unwritable"))
    if isinstance(error, WorkFailed):
        if error.trace:
            log.error("work raised", trace=error.trace)
        return JobFailed(type_of_failure(error.kind), error.message, error.faults)
    return error


class Heartbeat:
    """Says that a worker lives, and puts the work of dead workers back into its queues. Any number of workers may put
    back the same work."""

    def __init__(self, engine: sa.Engine, settings: ServiceSettings, events: EventLog, worker: str) -> None:
        self._engine, self._settings, self._events, self._id = engine, settings, events, worker
        self._here: set[str] = set()  # workflows that run in this process
        self._idle: dict[str, float] = {}  # those that it holds and that do not, and since when

    def keep_up(self, stop: threading.Event, outcomes: "Outcomes") -> None:
        """Writes heartbeats and finds dead workers, in its own thread, so that no job can delay it."""
        while not stop.wait(self._settings.heartbeat_s):
            try:
                self.beat()
                self.put_back()
                for job_id in outcomes.publish_set_aside():
                    log.warning("job set aside", job=job_id)
            except Exception as error:  # the database may be away for a while; the worker outlasts it
                log.error("heartbeat failed", error=str(error)[:300])

    def beat(self) -> None:
        """Writes that the worker lives."""
        machine, host, pid, started = process_identity()
        with self._engine.begin() as connection:
            seen = {"seen": now_sql(connection)}
            change = sa.update(workers).where(workers.c.id == self._id).values(**seen, stopped=None)
            if not connection.execute(change).rowcount:
                row = {"id": self._id, "machine": machine, "host": host, "pid": pid, "pid_started": started}
                row |= {"queue": self._settings.queue, "concurrency": self._settings.concurrency}
                row |= {"version": version("eigenhead"), "started": now_sql(connection)}
                connection.execute(sa.insert(workers).values(**row, **seen))

    def put_back(self) -> None:
        """Puts the jobs of dead workers, and lost jobs of this one, back into their queues."""
        dead = dead_workers(self._engine, self._settings.silent_s, except_id=self._id)
        for job_id in [*take_over(self._engine, dead), *self._take_back_lost()]:
            log.warning("job taken over", job=job_id)
            self._events.append(job_id, {"state": "queued", "stage": "queued", "progress": 0.0, "eta_s": None})
        with self._engine.begin() as connection:
            old = sa.and_(workers.c.id.in_(dead), workers.c.seen < now_sql(connection) - FORGET_S)
            connection.execute(sa.delete(workers).where(old))

    def _take_back_lost(self) -> list[str]:
        """Puts the workflows that the engine gave to this worker, and in which nothing runs for ``LOST_S`` seconds,
        back into their queues: how they ended could not be written, as on a disk that was full. Returns their ids."""
        job = engine_jobs(self._engine)
        names = job.c.name.in_((WORKFLOW, DELIVERY, calibrations.WORKFLOW))
        mine = sa.and_(job.c.status == RUNNING, job.c.executor_id == self._id, names)
        with self._engine.connect() as connection:
            held, now = [*connection.scalars(sa.select(job.c.workflow_uuid).where(mine))], time.monotonic()
        self._idle = {each: self._idle.get(each, now) for each in held if each not in self._here}
        lost = [each for each, since in self._idle.items() if now - since >= LOST_S]
        return _put_back(self._engine, job, sa.and_(mine, job.c.workflow_uuid.in_(lost))) if lost else []

    def end(self) -> None:
        """Writes that the worker stopped, if the database can be reached."""
        with suppress(SQLAlchemyError), self._engine.begin() as connection:
            connection.execute(sa.update(workers).where(workers.c.id == self._id).values(stopped=now_sql(connection)))

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Records the id of a running workflow, which ends without an outcome if the database refuses its writes."""
        identity = DBOS.workflow_id or ""
        self._here.add(identity)
        try:
            yield
        except AWAY as error:
            log.warning("interrupted", workflow=identity, reason=str(error)[:200])
            raise WorkerStopped from error
        finally:
            self._here.discard(identity)


class _StateWatch:
    """Returns whether a job should still run; it asks the database a few times a second."""

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._asked: dict[str, float] = {}

    def runs(self, job_id: str) -> bool:
        now = time.monotonic()
        if now - self._asked.get(job_id, 0.0) < self._every_s:
            return True
        self._asked = {job_id: now} | {k: t for k, t in self._asked.items() if now - t < 60.0 and k != job_id}
        try:
            row = DBOS.get_workflow_status(job_id)
        except Exception as error:  # the database is away: that is no reason to stop a fit
            log.warning("state of the job unknown", error=str(error)[:200])
            return True
        return row is not None and row.status in ("PENDING", "ENQUEUED")


def run_worker(settings: ServiceSettings, *, until_eof: bool = False) -> None:
    """Runs a worker until SIGTERM or SIGINT stops it; does not return. With ``until_eof`` it also stops at the end of
    its standard input, that is when its parent ends."""
    worker = Worker(settings)
    for number in (signal.SIGTERM, signal.SIGINT):  # before its row says that it lives: one that is ended says so there
        signal.signal(number, lambda *_: worker.stop())
    worker.start()
    if until_eof:
        threading.Thread(target=_stop_at_eof, args=(worker.stop,), daemon=True).start()
    worker.run_until_stopped()


def _stop_at_eof(stop: Callable[[], None]) -> None:
    while sys.stdin.buffer.read(4096):
        pass
    stop()


def dead_workers(engine: sa.Engine, silent_s: float, except_id: str = "") -> list[str]:
    """Lists the ids of dead workers: those that stopped, whose process on this machine is gone, or that sent no
    heartbeat for ``silent_s`` seconds. ``except_id`` is never listed."""
    machine = process_identity()[0]
    with engine.connect() as connection:
        silent = (workers.c.seen < now_sql(connection) - silent_s).label("silent")
        rows = connection.execute(sa.select(workers, silent).where(workers.c.id != except_id)).all()
    return [
        row.id
        for row in rows
        if row.stopped is not None
        or row.silent
        or (row.machine == machine and process_started(row.pid) != row.pid_started)
    ]


def take_over(engine: sa.Engine, dead: Collection[str]) -> list[str]:
    """Puts the running workflows of dead workers, and of those that have no row any more, back into their queues.
    Workflows that another worker has taken meanwhile stay. Returns the ids of the workflows put back."""
    job = engine_jobs(engine)
    with engine.connect() as connection:
        holders = {*connection.scalars(sa.select(job.c.executor_id).where(job.c.status == RUNNING).distinct())}
        known = {*connection.scalars(sa.select(workers.c.id))}  # asked second: a worker that begins now is no stray
    gone = {*dead, *holders - known} & holders
    return _put_back(engine, job, job.c.executor_id.in_(gone)) if gone else []


def _put_back(engine: sa.Engine, job: sa.TableClause, which: sa.ColumnElement[bool]) -> list[str]:
    back = {"status": "ENQUEUED", "owner_xid": None, "started_at_epoch_ms": None}
    change = sa.update(job).where(job.c.status == RUNNING, which)
    with engine.begin() as connection:
        changed = change.values(**back, updated_at=sa.cast(now_sql(connection) * 1000, sa.BigInteger))
        return [*connection.scalars(changed.returning(job.c.workflow_uuid))]


class Outcomes:
    """Writes how one worker's jobs ended: the last event, the count of failures, and messages to webhooks.

    Each write may be repeated, since a worker may be killed before the job engine knows that the job has ended; it
    waits for a database that does not answer, since a job without an end would seem to run."""

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
        """Writes the end of each job that took down the permitted number of workers, because no worker is alive to
        write it. Returns their ids."""
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


def warnings_of(report: Path) -> list[MessageDocument]:
    """Returns the warnings in a report.json; none if it is missing or holds none."""
    try:
        return json.loads(report.read_bytes())["warnings"]
    except (OSError, ValueError, KeyError, TypeError):  # no result, or another kind of work
        return []


def add_warning(report: Path, warning: Message) -> None:
    """Adds a warning to a report.json; does nothing if the work wrote no report."""
    with suppress(FileNotFoundError):
        document = json.loads(report.read_bytes())
        document["warnings"] = [*document["warnings"], warning.document()]
        write_atomically(report, json.dumps(document, indent=1, ensure_ascii=False).encode())


def described(folder: Path) -> dict[str, FileEntry]:
    """Returns size and SHA-256 of every file below ``folder``, by its relative name."""
    files: dict[str, FileEntry] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        files[path.relative_to(folder).as_posix()] = {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
    return files

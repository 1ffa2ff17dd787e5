"""Implements batches: many captures, one job each, in the same queues as other jobs and behind them.

A batch states the desired outcome for its captures. ``Batches.serve``, which the service calls every ``poll_s``
seconds, produces the desired outcome. ``serve`` keeps at most ``FED_MOST`` jobs of batches in each queue, so a batch of
ten thousand captures does not fill the queue. ``serve`` withdraws the queued jobs of a paused batch and cancels the
jobs of a cancelled one. After an interruption of ``serve``, the next call continues from the rows in the database.
"""

import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import sqlalchemy as sa
import structlog

from rig.errors import EigenheadError, InputError
from rig.files import document_sha256
from rig.messages.message import Message, compose
from server.errors import Conflict, DiskFull, NotFound, TooMany
from server.services.deliveries import destination
from server.services.job_rows import STATES, STATUSES
from server.services.jobs import Jobs
from server.services.records import BatchCounts, BatchOut, JobOut, moment_of
from server.services.texts import check_texts
from server.services.webhooks import Webhooks
from server.services.work import ReconstructionRequest
from server.settings import ServiceSettings
from server.storage.batches import ENQUEUED, GONE, WAITING, BatchItem, BatchRow, BatchState, Tally
from server.storage.database import slots_by_queue
from server.storage.library import Library
from server.storage.pages import Page
from server.storage.records import CaptureRecord, JobRequest
from server.storage.store import Store, is_id, new_id, repeatable_id

FED_MOST = 100  # jobs of batches that are queued or run in one queue: more than its workers end between two calls
FAULTS_MOST = 100  # of one refusal: ten thousand wrong ids need not all come back
PRIORITY = 500  # of a batch; a job has 100, and the lower number goes first
ITEM_STATES: tuple[str, ...] = ("waiting", "queued", "running", "succeeded", "failed", "cancelled", "removed")
UNDONE = ("waiting", "queued", "running")

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class BatchRequest:
    """Holds the request for a batch: the settings, the captures, and the queue (None: the service's default). Exactly
    one of three fields is set: ``captures`` (their ids), ``session`` (its id), or ``prefix`` (the beginning of their
    labels). Of two jobs the one with the lower ``priority`` runs first."""

    work: ReconstructionRequest
    captures: Sequence[str] | None = None
    session: str | None = None
    prefix: str | None = None
    label: str = ""
    queue: str | None = None
    priority: int = PRIORITY

    def digest(self) -> str:
        """Returns the SHA-256 of everything that was requested. A repeated request with the same idempotency key must
        have the same digest."""
        captures = None if self.captures is None else list(self.captures)
        wanted = [captures, self.session, self.prefix, self.work.model, self.work.settings]
        wanted += [self.label, self.queue, self.priority]
        wanted += [] if self.work.deliver_to is None else [self.work.deliver_to]  # digests of earlier versions lack it
        return document_sha256({"wanted": json.dumps(wanted, sort_keys=True)})


class Batches:
    """Manages the batches of a service. Methods block on the database, so call them from a thread."""

    def __init__(
        self,
        settings: ServiceSettings,
        engine: sa.Engine,
        store: Store,
        jobs: Jobs,
        library: Library,
        webhooks: Webhooks,
    ) -> None:
        self._settings, self._engine, self._store, self._jobs = settings, engine, store, jobs
        self._library, self._webhooks, self._index = library, webhooks, jobs.batches

    def submit(self, wanted: BatchRequest, *, key: str = "local", idempotency_key: str | None = None) -> BatchOut:
        """Begins a batch and returns it. A repeated request with the same idempotency key returns the batch that the
        first request made.

        Raises InputError for unknown models or settings and for captures that cannot be used, NotFound for an unknown
        session, DiskFull, TooMany if the API key has too many unfinished batches, and Conflict if its idempotency key
        was used for a different request.
        """
        wanted.work.check()
        check_texts({"label": wanted.label}, "request")
        self._jobs.check_queue(wanted.queue)
        place = None if wanted.work.deliver_to is None else destination(wanted.work.deliver_to, self._settings)
        identity = new_id() if idempotency_key is None else repeatable_id(key, f"batch {idempotency_key}")
        digest = wanted.digest()
        if idempotency_key is None or self._index.get(identity) is None:
            captures = self._chosen(wanted)
            self._store.reserve(0, self._settings.free_bytes)
            if len(self._index.unfinished(key)) >= self._settings.batches_per_key:
                most = self._settings.batches_per_key
                raise TooMany("too-many-batches", compose("too-many-batches", count=most), retry_after_s=60)
            row = BatchRow(
                id=identity,
                created=time.time_ns() // 1_000_000,
                label=wanted.label,
                key=key,
                digest=digest,
                queue=wanted.queue or self._settings.queue,
                priority=wanted.priority,
                model=wanted.work.model,
                settings=wanted.work.settings or {},
                deliver_to=place,
            )
            self._index.add(row, captures)
        first = self._known(identity)
        if first.digest != digest:
            raise Conflict("idempotency-conflict", compose("idempotency-key-reused"))
        return self._batches([first])[0]

    def get(self, identity: str) -> BatchOut:
        """Returns a batch with its present state. Raises NotFound."""
        return self._batches([self._known(identity)])[0]

    def page(
        self, sought: str = "", state: BatchState | None = None, limit: int = 100, cursor: str | None = None
    ) -> Page[BatchOut]:
        """Returns one page of the batches with all words of ``sought`` in their label, newest first. Raises InputError
        for a cursor of another list."""
        page = self._index.page(sought, state, limit, cursor)
        return page.of(self._batches(self._index.of(page.items)))

    def of(self, ids: Sequence[str]) -> list[BatchOut]:
        """Returns the batches with these ids, in their order; ids of no batch are left out."""
        return self._batches(self._index.of(ids))

    def pause(self, identity: str) -> BatchOut:
        """Starts no further job of a batch; jobs that run already continue. Queued jobs are withdrawn at the next call
        of ``serve``. Raises NotFound, and Conflict for a batch that has ended."""
        return self._change(identity, "paused")

    def resume(self, identity: str) -> BatchOut:
        """Continues a paused batch. Raises NotFound, and Conflict for a batch that has ended."""
        return self._change(identity, "running")

    def cancel(self, identity: str) -> BatchOut:
        """Cancels all jobs of a batch that have not ended, at the next call of ``serve``. A batch that has ended stays
        as it is. Raises NotFound."""
        self._known(identity)
        self._index.change(identity, "cancelled")
        return self.get(identity)

    def retry(self, identity: str) -> BatchOut:
        """Makes a new job for every capture whose job failed. Raises NotFound, and Conflict if no job failed or the
        batch was cancelled."""
        if self._known(identity).wish == "cancelled":
            raise Conflict("batch-ended", compose("batch-cancelled"))
        if not self._index.retry(identity, STATUSES["failed"]):
            raise Conflict("none-failed", compose("batch-none-failed"))
        return self.get(identity)

    def remove(self, identity: str) -> None:
        """Removes a batch that has ended; its jobs and their results stay. Raises NotFound, and Conflict for a batch
        that has not ended."""
        if self._known(identity).finished is None:
            raise Conflict("batch-active", compose("batch-active"))
        self._index.remove(identity)

    def serve(self) -> None:
        """Starts, withdraws and cancels jobs until they agree with the requested states of all batches, and records
        which batches have finished.

        The service calls ``serve`` every ``poll_s`` seconds. ``serve`` may run in several processes at once: a
        transaction that locks the batch's row assigns the jobs. After a kill the next call of ``serve`` goes on.
        """
        for identity, jobs in self._index.recalled().items():  # also those that an ended process left
            self._take_back(identity, jobs)
        rows, waiting = self._index.unfinished(), self._index.with_waiting()
        if not rows:
            return
        active = self._index.active()  # asked last: who waited then has a job since, or waits still
        room = {row.queue: FED_MOST for row in rows}
        for row in rows:
            room[row.queue] -= len(active.get(row.id, {}))
        for row in rows:
            jobs = active.get(row.id, {})
            if row.wish == "cancelled":
                self._cancel_jobs(list(jobs))
            elif row.wish == "paused":
                self._index.recall(row.id, queued := [job for job, status in jobs.items() if status in ENQUEUED])
                self._take_back(row.id, queued)
            elif row.id in waiting and room[row.queue] > 0:
                room[row.queue] -= self._feed(row, room[row.queue])
            if not jobs and (row.wish == "cancelled" or row.id not in waiting):
                self._webhooks.announce_batch(row.id, row.rounds, self._jobs.client.enqueue)
                self._index.finish(row, time.time_ns() // 1_000_000)

    def captures(self, identity: str) -> Iterator[tuple[str | None, JobOut | None]]:
        """Yields each capture of a batch in order: its id (None if it was erased) and its latest job (None if it has
        none)."""
        for items in self._index.items(identity):
            ids = [item.job_id for item in items if item.job_id is not None and is_id(item.job_id)]
            jobs = {job.id: job for job in self._jobs.of(ids)}
            yield from ((item.capture_id, jobs.get(item.job_id or "")) for item in items)

    def _known(self, identity: str) -> BatchRow:
        row = self._index.get(identity) if is_id(identity) else None
        if row is None:
            raise NotFound(compose("thing-batch"), identity)
        return row

    def _change(self, identity: str, wish: Literal["running", "paused"]) -> BatchOut:
        self._known(identity)
        if not self._index.change(identity, wish):
            raise Conflict("batch-ended", compose("batch-ended"))
        return self.get(identity)

    def _chosen(self, wanted: BatchRequest) -> Sequence[str]:
        ways = (wanted.captures, wanted.session, wanted.prefix)
        if sum(way is not None for way in ways) != 1:
            raise InputError("request", [compose("batch-selection")])
        if wanted.captures is not None:
            chosen, faults = wanted.captures, self._faults_of(wanted.captures)
        elif wanted.session is not None:
            self._store.session(wanted.session)
            chosen, faults = self._library.heads_of(wanted.session)[::-1], []
        else:
            chosen, faults = self._library.heads_labelled(wanted.prefix or ""), []
        if not chosen:
            faults = [compose("batch-none-chosen")]
        if len(chosen) > (most := self._settings.batch_captures):
            faults = [compose("batch-captures-many", count=len(chosen), most=most)]
        if len(faults) > FAULTS_MOST:
            faults = [*faults[:FAULTS_MOST], compose("batch-more-faults", count=len(faults) - FAULTS_MOST)]
        if faults:
            raise InputError("captures", faults)
        return chosen

    def _faults_of(self, captures: Sequence[str]) -> list[Message]:
        if len(captures) > self._settings.batch_captures:
            return []  # refused for that alone
        boards, faults = self._library.boards_among(captures), list[Message]()
        for capture, times in Counter(captures).items():
            if times > 1:
                faults.append(compose("batch-capture-repeated", capture=capture, times=times))
            if capture not in boards:
                faults.append(compose("batch-capture-unknown", capture=capture))
            elif boards[capture] and self._store.capture(capture).frames:
                faults.append(compose("batch-capture-film", capture=capture))
            elif boards[capture]:
                faults.append(compose("batch-capture-board", capture=capture))
        return faults

    def _feed(self, row: BatchRow, limit: int) -> int:
        """Queues jobs for the next captures of a batch, all in one transaction. Returns how many jobs were queued."""
        try:
            self._store.reserve(0, self._settings.free_bytes)
        except DiskFull:
            return 0  # readiness says so
        with self._engine.begin() as connection:
            items = self._index.waiting_within(connection, row.id, limit)
            jobs = {item.position: self._job_within(connection, row, item) for item in items}
            self._index.give_jobs_within(connection, row.id, jobs)
        return len(jobs)

    def _job_within(self, connection: sa.Connection, row: BatchRow, item: BatchItem) -> str | None:
        """Returns the id of a new job, None if the capture was removed after the batch began."""
        capture = self._store.found("captures", item.capture_id or "")
        if not isinstance(capture, CaptureRecord):
            return None
        request: JobRequest = {"capture_id": capture.id, "model": row.model, "settings": row.settings}
        if row.label:
            request["name"] = row.label
        if row.deliver_to is not None:
            request["deliver_to"] = row.deliver_to
        return self._jobs.enqueue_within(connection, request, capture.session, row)

    def _cancel_jobs(self, jobs: Sequence[str]) -> None:
        for job_id in jobs:
            with suppress(EigenheadError):  # it was erased meanwhile
                _, did = self._jobs.cancel(job_id)
                if did:
                    self._webhooks.announce(job_id, "cancelled", self._jobs.client.enqueue)

    def _take_back(self, identity: str, jobs: Sequence[str]) -> None:
        """Removes withdrawn jobs, so that their captures wait again; a job that ended before its withdrawal stays."""
        for job_id in jobs:
            taken = True
            with suppress(NotFound):  # erased, or removed before this was noted
                taken = self._jobs.cancel(job_id)[0].state == "cancelled"
                if taken:
                    self._jobs.delete(job_id)
            self._index.settle_recall(identity, job_id, taken=taken)

    def _batches(self, rows: Sequence[BatchRow]) -> list[BatchOut]:
        tallies = self._index.tallies([row.id for row in rows])
        slots = slots_by_queue(self._engine, self._settings.silent_s)
        return [self._batch(row, tallies[row.id], slots.get(row.queue, 0)) for row in rows]

    def _batch(self, row: BatchRow, tally: Tally, slots: int) -> BatchOut:
        counts: dict[str, int] = dict.fromkeys(ITEM_STATES, 0)
        special = {GONE: "removed", WAITING: "cancelled" if row.wish == "cancelled" else "waiting"}
        for status, count in tally.statuses.items():
            counts[special[status] if status in special else STATES[status]] += count
        ended = row.finished is not None
        state = row.wish if row.wish == "cancelled" or not ended else "finished"
        undone, eta_s = sum(counts[name] for name in UNDONE), None
        if state == "running" and undone and slots and tally.mean_s is not None:
            eta_s = tally.mean_s * undone / min(slots, undone)
        return BatchOut(
            id=row.id,
            label=row.label,
            state=state,
            created=moment_of(row.created),
            finished=None if row.finished is None else moment_of(row.finished),
            queue=row.queue,
            priority=row.priority,
            model=row.model,
            settings=dict(row.settings),
            deliver_to=row.deliver_to,
            total=sum(counts.values()),
            counts=BatchCounts(**counts),
            eta_s=eta_s,
            notice=self._jobs.queue_notice(row.queue) if state == "running" and undone else None,
        )

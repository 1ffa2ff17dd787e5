"""Stores batches in the database: each batch's request, and the job of each capture.

A batch is a row, and each of its captures is an item. An item without a job is waiting. The state of a job is never
copied: queries join the job engine's own row, so counts always agree with the jobs. Times are milliseconds since 1970.
"""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from server.storage.database import AT_ONCE, batch_items, batches, portions
from server.storage.job_index import ENQUEUED, RUNNING, engine_jobs
from server.storage.pages import Order, Page, contains, folded, page_of, storable, words_of

Wish = Literal["running", "paused", "cancelled"]
BatchState = Literal["running", "paused", "cancelled", "finished"]
WAITING, GONE = "waiting", "gone"  # of items, beside the engine's statuses
ACTIVE = (*ENQUEUED, RUNNING)
RECALLED = batch_items.c.recalled.is_(sa.true())
NONE = "-"  # in the place of a job's id: none is to be made, since the capture is gone


@dataclass(frozen=True, slots=True)
class BatchRow:
    """Holds a batch. ``wish`` is the state that the batch's owner requested: running, paused or cancelled. ``finished``
    is the time at which no work remained (ms since 1970), None before. ``rounds`` grows whenever the batch finishes and
    whenever its failed jobs are tried again."""

    id: str
    created: int
    label: str
    key: str
    digest: str
    queue: str
    priority: int
    model: str | None
    settings: Mapping[str, object]
    deliver_to: str | None = None
    wish: Wish = "running"
    finished: int | None = None
    rounds: int = 0


@dataclass(frozen=True, slots=True)
class BatchItem:
    """Holds one capture of a batch (None if it was erased) and the latest job for its head (None while it waits)."""

    position: int
    capture_id: str | None
    job_id: str | None


@dataclass(frozen=True, slots=True)
class Tally:
    """Counts the items of a batch by status: the job engine's, ``waiting``, or ``gone`` if the capture or job was
    removed. ``mean_s`` is the mean duration of the succeeded jobs, None before the first. On SQLite the job engine
    stores times in whole seconds."""

    statuses: Mapping[str, int]
    mean_s: float | None


class BatchIndex:
    """Reads and changes the rows of batches and their items. Methods block on the database."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine, self._status = engine, engine_jobs(engine)

    def add(self, row: BatchRow, captures: Sequence[str]) -> None:
        """Adds a batch with its captures in one transaction. Changes nothing if the batch's id is taken."""
        columns = {name: getattr(row, name) for name in BatchRow.__dataclass_fields__}
        columns |= {"label": storable(row.label), "words": folded(row.label), "settings": json.dumps(row.settings)}
        items = [{"batch_id": row.id, "position": place, "capture_id": one} for place, one in enumerate(captures)]
        with suppress(IntegrityError), self._engine.begin() as connection:
            connection.execute(sa.insert(batches).values(**columns))
            connection.execute(sa.insert(batch_items), items)

    def get(self, identity: str) -> BatchRow | None:
        """Returns the batch with this id; None if there is none."""
        return next(iter(self.of([identity])), None)

    def of(self, ids: Sequence[str]) -> list[BatchRow]:
        """Returns the batches with these ids, in their order; ids of no batch are left out."""
        with self._engine.connect() as connection:
            rows = connection.execute(sa.select(batches).where(batches.c.id.in_(ids)))
            found = {row.id: _row(row) for row in rows}
        return [found[identity] for identity in ids if identity in found]

    def page(self, sought: str, state: BatchState | None, limit: int, cursor: str | None) -> Page[str]:
        """Returns one page of batches, newest first. All words of ``sought`` must occur in the label; a word may also
        be the batch's id. Raises InputError for a cursor of another list."""
        rows = sa.select().select_from(batches)
        for word in words_of(sought):
            rows = rows.where(sa.or_(contains(batches.c.words, word), batches.c.id == word))
        if state is not None:
            rows = rows.where(_in_state(state))
        with self._engine.connect() as connection:
            return page_of(connection, rows, Order(batches.c.created, batches.c.id, descending=True), limit, cursor)

    def unfinished(self, key: str | None = None) -> list[BatchRow]:
        """Lists the batches that are not finished, in the order in which they are served: by priority, then oldest
        first. ``key``: only those of this API key."""
        query = sa.select(batches).where(batches.c.finished.is_(None))
        if key is not None:
            query = query.where(batches.c.key == key)
        with self._engine.connect() as connection:
            rows = connection.execute(query.order_by(batches.c.priority, batches.c.created, batches.c.id))
            return [_row(row) for row in rows]

    def tallies(self, ids: Collection[str]) -> dict[str, Tally]:
        """Counts the items of each of the batches by status."""
        item, job = batch_items.c, self._status.c
        waits = sa.or_(item.job_id.is_(None), RECALLED)
        status = sa.case((waits, WAITING), else_=sa.func.coalesce(job.status, GONE)).label("status")
        took = sa.func.avg(sa.cast(job.completed_at - job.started_at_epoch_ms, sa.Float)).label("took")
        joined = batch_items.outerjoin(self._status, job.workflow_uuid == item.job_id)
        query = sa.select(item.batch_id, status, sa.func.count().label("number"), took).select_from(joined)
        query = query.where(item.batch_id.in_(ids)).group_by(item.batch_id, status)
        counts: dict[str, dict[str, int]] = {identity: {} for identity in ids}
        means: dict[str, float] = {}
        with self._engine.connect() as connection:
            for row in connection.execute(query):
                counts[row.batch_id][row.status] = row.number
                if row.status == "SUCCESS" and row.took is not None:
                    means[row.batch_id] = row.took / 1000
        return {identity: Tally(counts[identity], means.get(identity)) for identity in ids}

    def items(self, identity: str) -> Iterator[list[BatchItem]]:
        """Yields the items of a batch in their order, in lists of ``AT_ONCE``."""
        item, after = batch_items.c, -1
        query = sa.select(item.position, item.capture_id, item.job_id).where(item.batch_id == identity)
        while True:
            with self._engine.connect() as connection:
                rows = connection.execute(query.where(item.position > after).order_by(item.position).limit(AT_ONCE))
                found = [BatchItem(row.position, row.capture_id, row.job_id) for row in rows]
            if not found:
                return
            yield found
            after = found[-1].position

    def active(self) -> dict[str, dict[str, str]]:
        """Returns the queued and running jobs of all batches, with the job engine's status, by batch and job."""
        item, job = batch_items.c, self._status.c
        query = sa.select(item.batch_id, item.job_id)
        found: dict[str, dict[str, str]] = {}
        with self._engine.connect() as connection:
            rows = connection.execute(sa.select(job.workflow_uuid, job.status).where(job.status.in_(ACTIVE)))
            active = {row.workflow_uuid: row.status for row in rows}  # few; joined, all items would be gone through
            for some in portions(active):
                for row in connection.execute(query.where(item.job_id.in_(some))):
                    found.setdefault(row.batch_id, {})[row.job_id] = active[row.job_id]
        return found

    def waiting_within(self, connection: sa.Connection, identity: str, limit: int) -> list[BatchItem]:
        """Returns the first ``limit`` items of a batch that have no job; none if the batch is not running.

        Locks the batch's row until the end of the caller's transaction, so that no other process assigns jobs to these
        items or changes the batch's ``wish``.
        """
        those = sa.update(batches).where(batches.c.id == identity, batches.c.wish == "running")
        if not connection.execute(those.values(wish="running")).rowcount:  # SQLite locks with the first change alone
            return []
        item = batch_items.c
        query = sa.select(item.position, item.capture_id, item.job_id).where(item.batch_id == identity)
        rows = connection.execute(query.where(item.job_id.is_(None)).order_by(item.position).limit(limit))
        return [BatchItem(row.position, row.capture_id, row.job_id) for row in rows]

    def give_jobs_within(self, connection: sa.Connection, identity: str, jobs: Mapping[int, str | None]) -> None:
        """Writes the job of each item, by position, in the caller's transaction. A job of None: the item's capture was
        removed, so the item gets no job."""
        place, job = sa.bindparam("place"), sa.bindparam("job")
        change = sa.update(batch_items).where(batch_items.c.batch_id == identity, batch_items.c.position == place)
        rows = [{"place": position, "job": job_id or NONE} for position, job_id in jobs.items()]
        if rows:
            connection.execute(change.values(job_id=job), rows)

    def recall(self, identity: str, jobs: Collection[str]) -> None:
        """Marks jobs of a batch for withdrawal, so that after a kill a later call can complete the withdrawal."""
        self._change_items(identity, list(jobs), {"recalled": True})

    def recalled(self) -> dict[str, list[str]]:
        """Returns the jobs that are marked for withdrawal, by batch."""
        query, found = sa.select(batch_items.c.batch_id, batch_items.c.job_id).where(RECALLED), dict[str, list[str]]()
        with self._engine.connect() as connection:
            for row in connection.execute(query):
                found.setdefault(row.batch_id, []).append(row.job_id)
        return found

    def settle_recall(self, identity: str, job_id: str, *, taken: bool) -> None:
        """Removes the mark for withdrawal from a job. If the job was withdrawn (``taken``), its capture waits again; a
        job that was not withdrawn had ended before and stays."""
        changed = {"recalled": False, "job_id": None} if taken else {"recalled": False}
        self._change_items(identity, [job_id], changed)

    def with_waiting(self) -> set[str]:
        """Returns the ids of unfinished batches with items that wait or whose job is being withdrawn."""
        with self._engine.connect() as connection:
            return {*connection.scalars(sa.select(batches.c.id).where(batches.c.finished.is_(None), _has_waiting()))}

    def change(self, identity: str, wish: Wish) -> bool:
        """Stores the requested state of a batch: running, paused or cancelled. Returns False, without any change, if
        the batch has finished or was cancelled before."""
        change = sa.update(batches).where(batches.c.id == identity, batches.c.finished.is_(None))
        with self._engine.begin() as connection:
            return bool(connection.execute(change.where(batches.c.wish != "cancelled").values(wish=wish)).rowcount)

    def finish(self, row: BatchRow, moment: int) -> None:
        """Marks a batch as finished at ``moment`` (ms since 1970). Does nothing if the batch was changed since ``row``
        was read, or has waiting items again."""
        change = sa.update(batches).where(batches.c.id == row.id, batches.c.finished.is_(None))
        change = change.where(batches.c.wish == row.wish, batches.c.rounds == row.rounds)
        if row.wish != "cancelled":
            change = change.where(~_has_waiting())
        with self._engine.begin() as connection:
            connection.execute(change.values(finished=moment, rounds=row.rounds + 1))

    def retry(self, identity: str, statuses: Collection[str]) -> int:
        """Makes all items wait again whose job has one of the job engine's ``statuses``, and reopens the batch. Returns
        the number of items."""
        item, job = batch_items.c, self._status.c
        joined = batch_items.join(self._status, job.workflow_uuid == item.job_id)
        query = sa.select(item.job_id).select_from(joined).where(item.batch_id == identity, job.status.in_(statuses))
        with self._engine.connect() as connection:
            failed = [*connection.scalars(query)]
        if failed:
            self._change_items(identity, failed, {"job_id": None}, reopen=True)
        return len(failed)

    def forget_captures(self, captures: Collection[str]) -> None:
        """Removes the ids of erased captures and of their jobs from all batches; removes the label and the destination
        of a batch without other captures, because they may name the subject."""
        item = batch_items.c
        with self._engine.begin() as connection:
            for some in portions(captures):
                those = item.capture_id.in_(some)
                affected = [*connection.scalars(sa.select(item.batch_id).where(those).distinct())]
                change = sa.update(batch_items).where(those)
                connection.execute(change.values(capture_id=None, job_id=NONE, recalled=False))
                others = sa.exists().where(item.batch_id == batches.c.id, item.capture_id.is_not(None))
                change = sa.update(batches).where(batches.c.id.in_(affected), ~others)
                connection.execute(change.values(label="", words="", deliver_to=None))

    def remove(self, identity: str) -> None:
        """Removes a batch and its items in one transaction. Jobs stay."""
        with self._engine.begin() as connection:
            connection.execute(sa.delete(batch_items).where(batch_items.c.batch_id == identity))
            connection.execute(sa.delete(batches).where(batches.c.id == identity))

    def _change_items(
        self, identity: str, jobs: list[str], values: Mapping[str, object], *, reopen: bool = False
    ) -> None:
        with self._engine.begin() as connection:
            for some in portions(jobs):
                those = batch_items.c.job_id.in_(some)
                change = sa.update(batch_items).where(batch_items.c.batch_id == identity, those)
                connection.execute(change.values(**values))
            if reopen:
                again = sa.update(batches).where(batches.c.id == identity)
                connection.execute(again.values(finished=None, rounds=batches.c.rounds + 1))


def _has_waiting() -> sa.ColumnElement[bool]:
    """Returns the SQL condition that items wait, made of two parts so that each can use an index."""
    item = batch_items.c
    those = item.batch_id == batches.c.id
    return sa.or_(sa.exists().where(those, item.job_id.is_(None)), sa.exists().where(those, RECALLED))


def _in_state(state: BatchState) -> sa.ColumnElement[bool]:
    """Returns the SQL condition for a state: a cancelled batch stays cancelled; any other is finished once no work
    remains."""
    table = batches.c
    if state == "cancelled":
        return table.wish == state
    if state == "finished":
        return sa.and_(table.wish != "cancelled", table.finished.is_not(None))
    return sa.and_(table.wish == state, table.finished.is_(None))


def _row(row: sa.Row) -> BatchRow:
    columns = {name: getattr(row, name) for name in BatchRow.__dataclass_fields__}
    return BatchRow(**columns | {"settings": json.loads(row.settings)})

"""Stores the events of each job in order; progress, remaining time and HTTP's event stream are read from them.

Failed jobs are counted by kind for the metrics; the counts stay when retention removes the jobs, so that alerts can use
them."""

import json
from dataclasses import dataclass

import sqlalchemy as sa
import structlog
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import IntegrityError

from server.storage.database import AWAY, events, failures, insert_into, now_sql
from server.storage.records import EventDocument

END = 2**31 - 1  # the number of a job's end, the largest of the column: the table's key holds that a job has one

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class JobEvent:
    """Holds one event of a job: its number within the job (``seq``), its time (s since 1970) and its content."""

    seq: int
    at: float
    document: EventDocument


class EventLog:
    """Reads and writes the events of jobs. Within a job the numbers of events grow from 1, even if another worker takes
    the job over. A superseded event's number is missing. The last event is the job's end, with the key ``END``."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine

    def append(self, job_id: str, document: EventDocument, instead_of: int | None = None) -> int | None:
        """Adds an event to a job under the next number, which it returns. ``instead_of``: the number of an event that
        the new one supersedes. If another writer takes the next number first, up to twenty attempts follow; then, or if
        the database does not answer, the event is dropped for the next one, which holds more, and None is returned."""
        event, text = events.c, json.dumps(document)
        following = sa.select(sa.func.coalesce(sa.func.max(event.seq), 0) + 1)
        following = following.where(event.job_id == job_id, event.seq < END)
        row = {"job_id": job_id, "seq": following.scalar_subquery(), "document": text, "at": now_sql(self._engine)}
        changes: list[sa.UpdateBase] = [sa.insert(events).values(**row).returning(event.seq)]
        if instead_of is not None:
            superseded = sa.and_(event.job_id == job_id, event.seq == instead_of)
            changes.insert(0, sa.update(events).where(superseded).values(**row).returning(event.seq))
        for _ in range(20):  # a taken-over job has two writers for a moment
            try:
                with self._engine.begin() as connection:
                    for change in changes:
                        if (seq := connection.scalar(change)) is not None:
                            return seq
            except IntegrityError:
                continue
            except AWAY as error:
                log.info("an event is not written", reason=str(error)[:200])
                return None
        return None

    def end(self, job_id: str, document: EventDocument, *, failure: str | None = None) -> bool:
        """Adds the end of a job, and counts a failed job under its kind ``failure``. Returns whether the job had no end
        before; an earlier end stays, uncounted. A worker may be killed before the job engine knows of the end; the
        worker that takes the job over then repeats the call."""
        insert = self._end(job_id, document).on_conflict_do_nothing().returning(events.c.seq)
        with self._engine.begin() as connection:
            is_first = connection.scalar(insert) is not None
            if is_first and failure is not None:
                note_failure(connection, failure)
        return is_first

    def replace_end(self, job_id: str, document: EventDocument) -> None:
        """Adds the end of a job in place of an end that a worker wrote too early."""
        insert = self._end(job_id, document)
        new = {"document": insert.excluded.document, "at": insert.excluded.at}
        with self._engine.begin() as connection:
            connection.execute(insert.on_conflict_do_update(index_elements=[events.c.job_id, events.c.seq], set_=new))

    def since(self, job_id: str, seq: int, limit: int = 1000) -> list[JobEvent]:
        """Returns the events of a job with numbers above ``seq``, in order, ``limit`` at most."""
        query = (
            sa.select(events).where(events.c.job_id == job_id, events.c.seq > seq).order_by(events.c.seq).limit(limit)
        )
        with self._engine.connect() as connection:
            return [JobEvent(row.seq, row.at, json.loads(row.document)) for row in connection.execute(query)]

    def latest(self, job_ids: list[str]) -> dict[str, JobEvent]:
        """Returns the newest event of each of the jobs; jobs without events are left out."""
        newest = sa.select(events.c.job_id, sa.func.max(events.c.seq).label("seq")).where(events.c.job_id.in_(job_ids))
        newest = newest.group_by(events.c.job_id).subquery()
        query = sa.select(events).join(
            newest, sa.and_(events.c.job_id == newest.c.job_id, events.c.seq == newest.c.seq)
        )
        with self._engine.connect() as connection:
            rows = connection.execute(query)
            return {row.job_id: JobEvent(row.seq, row.at, json.loads(row.document)) for row in rows}

    def remove(self, job_ids: list[str]) -> None:
        """Removes all events of these jobs."""
        with self._engine.begin() as connection:
            connection.execute(sa.delete(events).where(events.c.job_id.in_(job_ids)))

    def _end(self, job_id: str, document: EventDocument) -> "sqlite.Insert | postgresql.Insert":
        row = {"job_id": job_id, "seq": END, "document": json.dumps(document), "at": now_sql(self._engine)}
        return insert_into(self._engine, events).values(**row)


def note_failure(connection: sa.Connection, kind: str) -> None:
    """Adds one to the count of a kind of failure in the caller's transaction."""
    first = insert_into(connection, failures).values(kind=kind, count=1)
    more = {"count": failures.c["count"] + 1}
    connection.execute(first.on_conflict_do_update(index_elements=["kind"], set_=more))


def failure_counts(engine: sa.Engine) -> dict[str, int]:
    """Returns the number of failures by kind."""
    with engine.connect() as connection:
        return {row[0]: row[1] for row in connection.execute(sa.select(failures.c.kind, failures.c["count"]))}

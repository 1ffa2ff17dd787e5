"""Stores what happened to each job, in order: the source of progress, remaining time and the event stream of HTTP."""

import json
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from server.storage.database import events, now_sql
from server.storage.records import EventDocument


@dataclass(frozen=True, slots=True)
class JobEvent:
    """Holds one event of a job: its number within the job (``seq``), its time (s since 1970) and its content."""

    seq: int
    at: float
    document: EventDocument


class EventLog:
    """Reads and writes the events of jobs. Within a job their numbers grow, from 1, also if another worker takes the
    job over. A number is missing where its event was superseded."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine

    def append(self, job_id: str, document: EventDocument, instead_of: int | None = None) -> int | None:
        """Adds an event to a job under the next number, which it returns. ``instead_of``: the number of an event that
        the new one supersedes. If another writer takes the next number first, it tries again, twenty times; after that
        the event is dropped and it returns None."""
        event, text = events.c, json.dumps(document)
        following = sa.select(sa.func.coalesce(sa.func.max(event.seq), 0) + 1).where(event.job_id == job_id)
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
        return None

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

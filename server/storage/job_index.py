"""Finds jobs by the service's index rows, beside the job engine's own table, which holds the states of jobs.

The job engine's table is read only here and in ``batches``, by columns that its migrations keep. All other access to
that table goes through the engine's client.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from server.storage.database import batch_items, capture_index, job_index, portions
from server.storage.library import captures_with
from server.storage.pages import Order, Page, contains, folded, is_or_ends, page_of, words_of
from server.storage.records import JobRequest

ENQUEUED = ("DELAYED", "ENQUEUED")
RUNNING = "PENDING"
JobOrder = Literal["-created", "created", "-finished", "finished"]


@dataclass(frozen=True, slots=True)
class JobQuery:
    """Describes which jobs are listed and in what order. Every word of ``sought`` must occur in the job's name, model,
    method, level of detail or id, or in its capture. ``statuses`` are statuses of the job engine."""

    sought: str = ""
    statuses: Sequence[str] | None = None
    capture: str | None = None
    session: str | None = None
    batch: str | None = None
    order: JobOrder = "-created"


@dataclass(frozen=True, slots=True)
class Queued:
    """Holds how many jobs wait in a queue, and since when the oldest waits (s since 1970)."""

    jobs: int
    since: float


class JobIndex:
    """Finds jobs by words, capture, session, batch and state. ``workflow``: the job engine's name for this kind of job.
    Methods block on the database."""

    def __init__(self, engine: sa.Engine, workflow: str) -> None:
        self._engine, self._workflow = engine, workflow
        self._status = engine_jobs(engine)

    def add(self, job_id: str, request: JobRequest, session: str | None) -> None:
        """Adds a job to the index, unless the index already has it."""
        with suppress(IntegrityError), self._engine.begin() as connection:
            self.add_within(connection, job_id, request, session)

    def add_within(self, connection: sa.Connection, job_id: str, request: JobRequest, session: str | None) -> None:
        """Adds a new job to the index in the caller's transaction. Raises IntegrityError if the index has the job
        already."""
        row = {"job_id": job_id, "capture_id": request["capture_id"], "session": session}
        connection.execute(sa.insert(job_index).values(**row, words=words_of_job(request)))

    def remove(self, job_id: str) -> None:
        """Removes a job from the index, if it is there."""
        with self._engine.begin() as connection:
            connection.execute(sa.delete(job_index).where(job_index.c.job_id == job_id))

    def complete(self, requests_of: Callable[[list[str]], Mapping[str, JobRequest]]) -> int:
        """Fills in the searchable words in index rows that an earlier version wrote without them. ``requests_of``
        returns the requests of jobs by id. Returns how many rows lacked words."""
        with self._engine.connect() as connection:
            bare = [*connection.scalars(sa.select(job_index.c.job_id).where(job_index.c.words.is_(None)))]
        for some in portions(bare):
            requests = requests_of(some)
            words = {job: words_of_job(requests[job]) if job in requests else "" for job in some}
            change = sa.update(job_index).where(job_index.c.job_id == sa.bindparam("job"))
            with self._engine.begin() as connection:
                connection.execute(
                    change.values(words=sa.bindparam("new")), [{"job": j, "new": w} for j, w in words.items()]
                )
        return len(bare)

    def page(self, query: JobQuery, limit: int, cursor: str | None = None) -> Page[str]:
        """Returns one page of the jobs that match a query. Raises InputError for a cursor of another list."""
        status = self._status.c
        rows = sa.select().select_from(self._status).where(status.name == self._workflow)
        if query.statuses is not None:
            rows = rows.where(status.status.in_(query.statuses))
        if clauses := self._of(query):
            rows = rows.where(status.workflow_uuid.in_(sa.select(job_index.c.job_id).where(*clauses)))
        finished = query.order.endswith("finished")
        column = sa.func.coalesce(status.completed_at, 0) if finished else status.created_at
        order = Order(column, status.workflow_uuid, query.order.startswith("-"))
        with self._engine.connect() as connection:
            return page_of(connection, rows, order, limit, cursor, searched=bool(query.sought))

    def counts(self) -> dict[str, int]:
        """Returns the number of jobs by the job engine's status."""
        status = self._status.c
        query = sa.select(status.status, sa.func.count()).where(status.name == self._workflow).group_by(status.status)
        with self._engine.connect() as connection:
            return {row[0]: row[1] for row in connection.execute(query)}

    def queued(self) -> dict[str, Queued]:
        """Returns how many jobs wait in each queue, and since when the oldest waits."""
        status = self._status.c
        query = sa.select(status.queue_name, sa.func.count(), sa.func.min(status.created_at))
        query = query.where(status.name == self._workflow, status.status.in_(ENQUEUED)).group_by(status.queue_name)
        with self._engine.connect() as connection:
            return {row[0]: Queued(row[1], row[2] / 1000) for row in connection.execute(query)}

    def newest_first(self, statuses: Sequence[str]) -> list[str]:
        """Lists the ids of all jobs that have one of the engine's ``statuses``, newest first."""
        status = self._status.c
        query = sa.select(status.workflow_uuid).where(status.name == self._workflow, status.status.in_(statuses))
        with self._engine.connect() as connection:
            return [*connection.scalars(query.order_by(status.created_at.desc()))]

    def places(self) -> dict[str, int]:
        """Returns for each queued job how many jobs of its queue run before it.

        Running jobs go first, then those with a lower priority number, then those queued earlier. Of jobs queued in the
        same millisecond the lower id counts as earlier, although the engine takes them in any order.
        """
        status = self._status.c
        places: dict[str, int] = {}
        running = sa.select(status.queue_name, sa.func.count()).where(status.name == self._workflow)
        running = running.where(status.status == RUNNING).group_by(status.queue_name)
        queued = sa.select(status.workflow_uuid, status.queue_name).where(status.name == self._workflow)
        queued = queued.where(status.status.in_(ENQUEUED))
        order = (status.priority, status.created_at, status.workflow_uuid)
        with self._engine.connect() as connection:
            before = {row[0]: row[1] for row in connection.execute(running)}
            for row in connection.execute(queued.order_by(*order)):
                places[row.workflow_uuid] = before.get(row.queue_name, 0)
                before[row.queue_name] = places[row.workflow_uuid] + 1
        return places

    def of_captures(self, captures: Collection[str]) -> dict[str, list[tuple[str, str]]]:
        """Returns id and status (as the job engine names it, such as "PENDING") of the jobs of each of the captures,
        newest first. A capture without jobs has an empty list."""
        found: dict[str, list[tuple[str, str]]] = {capture: [] for capture in captures}
        status = self._status.c
        joined = job_index.join(self._status, status.workflow_uuid == job_index.c.job_id)
        query = sa.select(job_index.c.capture_id, job_index.c.job_id, status.status).select_from(joined)
        query = query.order_by(status.created_at.desc(), job_index.c.job_id.desc())
        with self._engine.connect() as connection:
            for some in portions(captures):
                for row in connection.execute(query.where(job_index.c.capture_id.in_(some))):
                    found[row.capture_id].append((row.job_id, row.status))
        return found

    def known(self, ids: Collection[str]) -> set[str]:
        """Returns the ids that are jobs."""
        status = self._status.c
        query = sa.select(status.workflow_uuid).where(status.name == self._workflow, status.workflow_uuid.in_(ids))
        with self._engine.connect() as connection:
            return {*connection.scalars(query)}

    def ids_of(self, capture: str | None, session: str | None) -> list[str]:
        """Lists the ids of the jobs of a capture, of a session, or of both if both are not None."""
        with self._engine.connect() as connection:
            clauses = self._of(JobQuery(capture=capture, session=session))
            return [*connection.scalars(sa.select(job_index.c.job_id).where(*clauses))]

    def _of(self, query: JobQuery) -> list[sa.ColumnElement[bool]]:
        row, clauses = job_index.c, []
        if query.capture is not None:
            clauses.append(row.capture_id == query.capture)
        if query.session is not None:
            clauses.append(row.session == query.session)
        if query.batch is not None:
            theirs = sa.select(batch_items.c.job_id).where(batch_items.c.batch_id == query.batch)
            clauses.append(row.job_id.in_(theirs.where(batch_items.c.job_id.is_not(None))))
        for word in words_of(query.sought):
            captures = sa.select(capture_index.c.id).where(captures_with(word))
            matches = sa.or_(contains(row.words, word), is_or_ends(row.job_id, word))
            clauses.append(sa.or_(matches, row.capture_id.in_(captures)))
        return clauses


def engine_jobs(engine: sa.Engine) -> sa.TableClause:
    """Returns the job engine's table of workflows, with the columns that are used here."""
    text, number = sa.Text(), sa.BigInteger()
    names = {"workflow_uuid": text, "status": text, "name": text, "queue_name": text, "executor_id": text}
    names |= {"created_at": number, "started_at_epoch_ms": number, "completed_at": number, "priority": number}
    names |= {"updated_at": number, "owner_xid": text}
    columns = [sa.column(name, kind) for name, kind in names.items()]
    return sa.table("workflow_status", *columns, schema=None if engine.dialect.name == "sqlite" else "dbos")


def words_of_job(request: JobRequest) -> str:
    """Returns the text that a search for jobs compares: name, model, method and level of detail, in lower case."""
    settings = request.get("settings") or {}
    chosen = [str(settings[key]) for key in ("method", "detail") if settings.get(key)]
    return folded(request.get("name"), request.get("model") or "default", *(chosen or ["contour"]))

"""Configures the job engine (DBOS) for the worker, decides which workers are dead, and takes their jobs back.

The jobs of dead workers are put back into their queues by one statement on the engine's table, before a new worker
takes its first job: so an interrupted job keeps its place. The engine's own ways do not serve: resume_workflow takes a
job from whoever has it by now, revives a cancelled one and forgets how many workers the job took down; its recovery is
private, and begins only when jobs are taken already.
"""

from collections.abc import Collection

import sqlalchemy as sa
from dbos import DBOSConfig

from server.processes import process_identity, process_started
from server.services.failures import SERIALIZER
from server.services.job_rows import APPLICATION, APPLICATION_VERSION
from server.settings import ServiceSettings
from server.storage.database import now_sql, workers
from server.storage.job_index import RUNNING, engine_jobs


def engine_config(settings: ServiceSettings, executor_id: str) -> DBOSConfig:
    """Returns the job engine's configuration for the worker ``executor_id``."""
    return {
        "name": APPLICATION,
        "system_database_url": settings.url,
        "application_version": APPLICATION_VERSION,
        "executor_id": executor_id,
        "enable_otlp": False,
        "log_level": "WARNING",
        "notification_listener_polling_interval_sec": 1.0,
        "serializer": SERIALIZER,
    }


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
    Workflows that another worker has taken meanwhile are left alone. Returns the ids of those put back."""
    job = engine_jobs(engine)
    with engine.connect() as connection:
        holders = {*connection.scalars(sa.select(job.c.executor_id).where(job.c.status == RUNNING).distinct())}
        known = {*connection.scalars(sa.select(workers.c.id))}  # asked second: a worker that begins now is no stray
    gone = {*dead, *holders - known} & holders
    return _put_back(engine, job, job.c.executor_id.in_(gone)) if gone else []


def take_back(engine: sa.Engine, executor_id: str, lost: Collection[str]) -> list[str]:
    """Puts workflows of a living worker, in which nothing runs any more, back into their queues, as ``take_over``."""
    job = engine_jobs(engine)
    which = sa.and_(job.c.executor_id == executor_id, job.c.workflow_uuid.in_(lost))
    return _put_back(engine, job, which) if lost else []


def held_by(engine: sa.Engine, executor_id: str, names: Collection[str]) -> list[str]:
    """Lists the ids of the running workflows of these names that a worker holds."""
    job = engine_jobs(engine).c
    query = sa.select(job.workflow_uuid).where(job.status == RUNNING, job.executor_id == executor_id)
    with engine.connect() as connection:
        return [*connection.scalars(query.where(job.name.in_(names)))]


def _put_back(engine: sa.Engine, job: sa.TableClause, which: sa.ColumnElement[bool]) -> list[str]:
    back = {"status": "ENQUEUED", "owner_xid": None, "started_at_epoch_ms": None}
    change = sa.update(job).where(job.c.status == RUNNING, which)
    with engine.begin() as connection:
        changed = change.values(**back, updated_at=sa.cast(now_sql(connection) * 1000, sa.BigInteger))
        return [*connection.scalars(changed.returning(job.c.workflow_uuid))]

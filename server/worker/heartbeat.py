"""Decides which workers are dead, by their heartbeats and their processes."""

import sqlalchemy as sa

from server.processes import process_identity, process_started
from server.storage.database import now_sql, workers


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

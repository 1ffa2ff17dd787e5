"""Jobs of dead workers go back into their queues, and no others: on the engine's table as its own release makes it."""

from pathlib import Path

import sqlalchemy as sa
from dbos import DBOS

from server.settings import ServiceSettings
from server.storage.database import now_sql, open_database, workers
from server.storage.job_index import engine_jobs
from server.worker.worker import take_over

ALIVE = {"machine": "m", "host": "h", "pid": 1, "pid_started": 1, "queue": "cpu", "concurrency": 1, "version": "0"}


def test_jobs_of_the_dead_and_of_strays_go_back_to_their_places(tmp_path: Path) -> None:
    settings = ServiceSettings(data=tmp_path)
    DBOS.migrate(system_database_url=settings.url)
    engine = open_database(settings)
    table = sa.Table("workflow_status", sa.MetaData(), autoload_with=engine)
    rows = [("a", "PENDING", "dead"), ("b", "PENDING", "stray"), ("c", "PENDING", "alive"), ("d", "CANCELLED", "dead")]
    with engine.begin() as connection:
        for job, status, holder in rows:
            row = {"workflow_uuid": job, "status": status, "executor_id": holder, "queue_name": "cpu", "priority": 7}
            row |= {"recovery_attempts": 1, "started_at_epoch_ms": 5, "owner_xid": "x", "name": "reconstruct"}
            connection.execute(sa.insert(table).values(**row))
        for name in ("alive", "dead"):
            beat = {"started": now_sql(engine), "seen": now_sql(engine)}
            connection.execute(sa.insert(workers).values(id=name, **ALIVE, **beat))
        before = {row.workflow_uuid: row for row in connection.execute(sa.select(table))}
    assert sorted(take_over(engine, ["dead"])) == ["a", "b"]
    assert take_over(engine, ["dead"]) == []
    with engine.connect() as connection:
        after = {row.workflow_uuid: row for row in connection.execute(sa.select(table))}
    assert {job: row.status for job, row in after.items()} == {
        "a": "ENQUEUED", "b": "ENQUEUED", "c": "PENDING", "d": "CANCELLED"
    }  # fmt: skip
    assert (after["a"].owner_xid, after["a"].started_at_epoch_ms, after["a"].queue_name) == (None, None, "cpu")
    assert (after["a"].created_at, after["a"].recovery_attempts) == (before["a"].created_at, 1), "its place, its count"
    assert (after["c"], after["d"]) == (before["c"], before["d"])
    assert {*engine_jobs(engine).c.keys()} <= {*table.c.keys()}

"""What jobs cost their PostgreSQL: statements and bytes.

python -m tests.laboratory database_costs 200 20 8

A service and its worker, each with its default pauses, are counted by pg_stat_statements (Debian's postgresql package
brings it): idle for ``IDLE_S``; while JOBS pinned jobs of no length run; and while LONG_JOBS of SECONDS seconds run
side by side. ``statements_a_job``: those of a job of no length, its submission over HTTP included, and BEGIN and COMMIT
counted, less those of an idle farm in that time; ``statements_a_job_second``: what each second adds that a job runs.
``bytes_a_job``: what tables and their indexes grew by at the end of the jobs, vacuumed; ``rows_left``: what remains of
that once all jobs were removed, as retention does it; ``capacity_statements_per_s``: what pgbench gets.
"""

import re
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psycopg

from tests.server.worker.test_durability import pinned_worker
from tests.support.postgres import programs, running_postgres
from tests.support.services import running_service, uploaded_capture

IDLE_S = 8.0
SHOWN = 12  # most frequent statements
DEFAULTS = {"heartbeat_s": "3", "poll_s": "0.25", "silent_s": "15", "sweep_s": "1000", "jobs_per_key": "100000"}
SIZES = """SELECT relname, pg_total_relation_size(oid) FROM pg_class
           WHERE relkind = 'r' AND relnamespace::regnamespace::text IN ('public', 'dbos')"""
OF_JOBS = ("eigenhead_events", "eigenhead_job_index") + tuple(
    f"dbos.{table}" for table in ("workflow_status", "workflow_input", "workflow_output", "operation_outputs")
)
UNDER_WAY = """SELECT count(*) /* pg_stat_statements */ FROM dbos.workflow_status
               WHERE status IN ('PENDING', 'ENQUEUED')"""


@dataclass(frozen=True)
class Database:
    connection: "psycopg.Connection[Any]"

    def calls(self) -> Counter[str]:
        """How often each statement was executed so far."""
        rows = self.connection.execute(
            "SELECT query, sum(calls)::int FROM pg_stat_statements GROUP BY query"
        ).fetchall()
        return Counter({query: calls for query, calls in rows if "pg_stat_statements" not in query})

    def bytes(self) -> Counter[str]:
        """Sizes of the service's tables with their indexes, without room that is free."""
        self.connection.execute("VACUUM FULL")
        return Counter(dict(self.connection.execute(SIZES).fetchall()))

    def rows(self) -> int:
        """How many rows of jobs there are in all tables."""
        counts = " + ".join(f"(SELECT count(*) FROM {table})" for table in OF_JOBS)
        return self.connection.execute(f"SELECT {counts}".encode()).fetchall()[0][0]

    def during(self, act: Callable[[], object]) -> tuple[Counter[str], float]:
        before, began = self.calls(), time.monotonic()
        act()
        seconds = time.monotonic() - began
        return self.calls() - before, seconds

    def run(self, client: httpx.Client, capture: str, jobs: int, seconds: float) -> None:
        """Submits jobs and waits for the end of all; the waiting is not counted."""
        wanted = {"capture_id": capture, "settings": {"front": f"{seconds:g}"}}
        for _ in range(jobs):
            client.post("/v1/jobs", json=wanted).raise_for_status()
        while self.connection.execute(UNDER_WAY).fetchone() != (0,):
            time.sleep(0.25)


def capacity(url: str, folder: Path) -> float:
    """Statements a second of this machine's PostgreSQL, by pgbench with four clients: what a worker asks most."""
    script = folder / "ask.sql"
    script.write_text("BEGIN;\nSELECT status FROM dbos.workflow_status WHERE workflow_uuid = 'none';\nCOMMIT;\n")
    command = [str(programs() / "pgbench"), "-n", "-c", "4", "-T", "5", "-f", str(script), url]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return 3 * float(re.findall(r"tps = ([\d.]+)", done.stdout)[0])


def run(jobs: int = 200, seconds: float = 20.0, long_jobs: int = 8, *, scratch: Path) -> dict[str, Any]:
    """Returns the figures of this module."""
    with ExitStack() as stack:
        url = stack.enter_context(running_postgres("-c shared_preload_libraries=pg_stat_statements"))
        settings: dict[str, Any] = {
            **DEFAULTS,
            "database_url": url,
            "work": "tests.support.tiny:work",
            "keep_jobs": "1000000",
        }
        service = stack.enter_context(running_service(scratch / "data", worker=False, **settings))
        client = stack.enter_context(httpx.Client(base_url=service.url, timeout=120))
        database = Database(stack.enter_context(psycopg.connect(url, autocommit=True)))
        database.connection.execute("CREATE EXTENSION pg_stat_statements")
        capture = uploaded_capture(service, scratch)
        time.sleep(2.0)
        alone, alone_s = database.during(lambda: time.sleep(IDLE_S))
        service.environment["EIGENHEAD_CONCURRENCY"] = str(long_jobs)
        stack.enter_context(pinned_worker(service, 0))
        database.run(client, capture, 3 * long_jobs, 0.5)  # every child is started
        idle, idle_s = database.during(lambda: time.sleep(IDLE_S))
        idle_per_s = idle.total() / idle_s
        empty = database.bytes()
        short, short_s = database.during(lambda: database.run(client, capture, jobs, 0.0))
        after_short = database.bytes()
        long, long_s = database.during(lambda: database.run(client, capture, long_jobs, seconds))
        after_long = database.bytes()
        for job in client.get("/v1/jobs", params={"limit": 1000}).raise_for_status().json()["jobs"]:
            client.delete(f"/v1/jobs/{job['id']}").raise_for_status()
        left = database.rows()
        most = capacity(url, scratch)
    a_job = (short.total() - idle_per_s * short_s) / jobs
    grown = after_short - empty
    figures = {
        "jobs": jobs,
        "idle_statements_per_s": {"service": round(alone.total() / alone_s, 1), "with a worker": round(idle_per_s, 1)},
        "statements_a_job": round(a_job, 1),
        "statements_a_job_second": round(((long.total() - idle_per_s * long_s) / long_jobs - a_job) / seconds, 2),
        "bytes_a_job": round(grown.total() / jobs),
        "bytes_a_job_by_table": {table: round(size / jobs) for table, size in grown.most_common(SHOWN)},
        f"bytes_a_job_of_{seconds:g}_s": round((after_long - after_short).total() / long_jobs),
        "rows_left": left,
        "capacity_statements_per_s": round(most),
        "often, idle, per second": often(idle, idle_s),
        "often, of a job that runs, per second": often(long - alone, long_jobs * long_s),
    }
    return {"figures": figures}


def often(calls: Counter[str], by: float) -> dict[str, float]:
    return {" ".join(query.split())[:120]: round(count / by, 2) for query, count in calls.most_common(SHOWN)}

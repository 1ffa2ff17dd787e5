"""A job's end is written once, also where its worker was killed before the engine knew of it, and where no worker lived
to write it."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager

import httpx
import pytest

from server.cli.client import Client
from server.storage.events import END
from tests.support.services import RunningService, await_state, await_true, upload


@contextmanager
def database(service: RunningService) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(service.data / "eigenhead.sqlite", timeout=30, isolation_level=None)) as connection:
        yield connection


def ends(service: RunningService, job: str) -> list[tuple[int, str]]:
    with database(service) as connection:
        query = (
            "SELECT seq, document ->> 'state' AS state FROM eigenhead_events WHERE job_id = ? AND state NOT IN (?, ?)"
        )
        return connection.execute(query, (job, "running", "queued")).fetchall()


@pytest.mark.parametrize("mode", ["cam00", "fail"])
def test_an_end_that_the_engine_does_not_know_is_not_written_again(
    service: RunningService, http: httpx.Client, client: Client, archive: bytes, mode: str
) -> None:
    job = client.submit(upload(http, archive).json()["id"], settings={"front": mode})["id"]
    before = await_state(http, job, ("succeeded", "failed"))
    counted = "SELECT sum(count) FROM eigenhead_failures"
    as_if_killed = "UPDATE workflow_status SET status = 'PENDING', executor_id = 'gone' WHERE workflow_uuid = ?"
    with database(service) as connection:
        failures = connection.execute(counted).fetchone()
        assert connection.execute(as_if_killed, (job,)).rowcount == 1
        after = await_state(http, job, ("succeeded", "failed"))
        assert connection.execute(counted).fetchone() == failures
    assert (after["state"], after["files"]) == (before["state"], before["files"])
    assert f"job taken over                 job={job}" in service.log.read_text()
    assert ends(service, job) == [(END, before["state"])]


def test_the_end_of_a_job_that_kills_its_workers_is_written_too(
    service: RunningService, http: httpx.Client, client: Client, archive: bytes
) -> None:
    job = client.submit(upload(http, archive).json()["id"])["id"]
    await_state(http, job, ("succeeded",))
    with database(service) as connection:
        connection.execute("DELETE FROM eigenhead_events WHERE job_id = ?", (job,))
        status = "UPDATE workflow_status SET status = 'MAX_RECOVERY_ATTEMPTS_EXCEEDED' WHERE workflow_uuid = ?"
        connection.execute(status, (job,))
    await_true(lambda: ends(service, job) == [(END, "failed")])
    with database(service) as connection:  # what other tests count
        connection.execute("UPDATE workflow_status SET status = 'SUCCESS' WHERE workflow_uuid = ?", (job,))

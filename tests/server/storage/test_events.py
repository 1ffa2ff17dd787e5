"""The events of jobs: numbers that grow, one writer or two, one end, and no more rows for a long job than for a short
one."""

import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest
import sqlalchemy as sa
from psycopg import Cursor
from sqlalchemy import event as sa_event
from sqlalchemy.exc import OperationalError

from server.settings import ServiceSettings
from server.storage.database import open_database
from server.storage.events import END, EventLog, failure_counts
from server.tasks.progress import JobProgress, ProgressMeter
from tests.support.at_once import run_at_once
from tests.support.postgres import running_postgres


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    with running_postgres() as url:
        yield url


@pytest.fixture
def log(tmp_path: Path) -> Iterator[EventLog]:
    engine = open_database(ServiceSettings(data=tmp_path / "data"))
    yield EventLog(engine)
    engine.dispose()


@pytest.fixture(params=["sqlite", "postgresql"])
def engine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[sa.Engine]:
    where = {} if request.param == "sqlite" else {"database_url": request.getfixturevalue("postgres")}
    engine = open_database(ServiceSettings(data=tmp_path / "data", **where))
    yield engine
    engine.dispose()


def test_a_new_event_supersedes_the_one_that_it_names(log: EventLog) -> None:
    for job, share in (("a", 0.0), ("b", 0.0), ("a", 0.25)):
        log.append(job, {"stage": "fit", "progress": share})
    assert log.append("a", {"stage": "fit", "progress": 0.5}, instead_of=2) == 3
    assert [(event.seq, event.document.get("progress")) for event in log.since("a", 0)] == [(1, 0.0), (3, 0.5)]
    assert log.append("a", {"stage": "fit", "progress": 0.6}, instead_of=2) == 4, "it was superseded before"
    assert [event.seq for event in log.since("a", 0)] == [1, 3, 4]
    assert [event.seq for event in log.since("b", 0)] == [1]


def test_two_writers_never_share_a_number(log: EventLog) -> None:
    numbers = list[int | None]()

    def write() -> None:
        last = None
        for _ in range(20):
            last = log.append("job", {"state": "running"}, instead_of=last)
            numbers.append(last)

    run_at_once(write)
    assert sorted(filter(None, numbers)) == list(range(1, 41))
    assert len(log.since("job", 0)) == 2


def test_a_long_job_has_as_many_events_as_it_has_stages(log: EventLog) -> None:
    seconds = 0.0
    meter = ProgressMeter(log, "job", JobProgress({"read": 1.0, "fit": 9.0}, lambda: seconds), every_s=0.0)
    seen = list[float]()
    for step in range(100):
        seconds = step / 10
        meter.report("read" if step < 10 else "fit", step % 10 / 10)
        new = log.since("job", int(seen[-1]) if seen else 0)
        seen += [event.seq for event in new]
    assert len(seen) == len({*seen}) == 100, "whoever looks often sees each"
    kept = [(event.document.get("stage"), event.seq) for event in log.since("job", 0)]
    assert kept == [("read", 1), ("fit", 11), ("fit", 100)]


def test_a_job_ends_once_however_many_write_it(engine: sa.Engine) -> None:
    log = EventLog(engine)
    log.append("job", {"state": "running", "stage": "fit"})

    def write() -> list[bool]:
        return [log.end("job", {"state": "failed"}, failure="no-subject") for _ in range(5)]

    assert sorted(chain(*run_at_once(write, 4))) == [False] * 19 + [True]
    assert log.append("job", {"state": "running", "stage": "late"}) == 2, "of a worker that was thought dead"
    assert [(event.seq, event.document.get("state")) for event in log.since("job", 0)][1:] == [
        (2, "running"),
        (END, "failed"),
    ]
    assert log.latest(["job"])["job"].document == {"state": "failed"}
    assert failure_counts(engine) == {"no-subject": 1}
    log.replace_end("job", {"state": "cancelled"})
    assert [event.document.get("state") for event in log.since("job", 2)] == ["cancelled"]


def test_a_database_that_is_away_costs_an_event_and_nothing_else(engine: sa.Engine) -> None:
    log = EventLog(engine)

    @sa_event.listens_for(engine, "before_cursor_execute")
    def refuse(*_: object) -> None:
        raise OperationalError("INSERT", None, ConnectionRefusedError("away"))

    meter = ProgressMeter(log, "other", JobProgress({"read": 1.0}), every_s=0.0)
    meter.report("read", 0.5)
    sa_event.remove(engine, "before_cursor_execute", refuse)
    meter.report("read", 0.6)
    assert [event.seq for event in log.since("other", 0)] == [1]


def test_a_transaction_that_a_cut_link_held_up_costs_an_event_alone(tmp_path: Path, postgres: str) -> None:
    """PostgreSQL ends its session, which the next statement hears."""
    engine = open_database(ServiceSettings(data=tmp_path / "data", database_url=postgres, silent_s=0.2))
    log, held = EventLog(engine), list[int]()

    @sa_event.listens_for(engine, "before_cursor_execute")
    def hold_up(connection: sa.Connection, cursor: Cursor[object], *_: object) -> None:
        if not held:
            held.append(1)
            cursor.execute("SELECT 1")  # the transaction begins
            time.sleep(0.5)

    assert log.append("held up", {"state": "running"}) is None
    assert log.append("held up", {"state": "running"}) == 1
    engine.dispose()

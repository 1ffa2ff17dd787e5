"""A worker's steps one by one, without the engine around them: what each leaves on disk and in the job's events. What
SIGKILL may not do to them is driven in ``test_durability.py``. Jobs of dead workers go back into their queues, and no
others: on the engine's table as its own release makes it."""

import hashlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from dbos import DBOS
from sqlalchemy import event
from sqlalchemy.exc import OperationalError

from rig.errors import Cancelled, InputError
from server.services.failures import JobFailed
from server.settings import ServiceSettings
from server.storage.database import now_sql, open_database, workers
from server.storage.events import failure_counts
from server.storage.job_index import engine_jobs
from server.storage.records import DeliveryRequest, FileEntry, JobRequest
from server.storage.store import Store, new_id
from server.tasks.child import WorkFailed
from server.worker.worker import Worker, described, failure_of, take_over, warnings_of
from tests.support.services import small_capture
from tests.support.stored_captures import stored_files

JOB = "0123456789ab" + 16 * "c"
ALIVE = {"machine": "m", "host": "h", "pid": 1, "pid_started": 1, "queue": "cpu", "concurrency": 1, "version": "0"}


class Engine:
    """What the engine says of the job's state; ``None``: it has gone."""

    def __init__(self) -> None:
        self.status: str | None = "PENDING"
        self.output: dict[str, FileEntry] | None = None

    def get_workflow_status(self, job_id: str) -> Any:
        return None if self.status is None else type("Row", (), {"status": self.status, "output": self.output})


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Engine:
    engine = Engine()
    monkeypatch.setattr(DBOS, "get_workflow_status", engine.get_workflow_status)
    return engine


@pytest.fixture
def worker(tmp_path: Path, engine: Engine, monkeypatch: pytest.MonkeyPatch) -> Iterator[Worker]:
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path / "cache"))
    settings = ServiceSettings(data=tmp_path / "data", work="tests.support.tiny:work", poll_s=0.05, free_bytes=1000)
    worker = Worker(settings)
    yield worker
    worker._children.close()
    worker.engine.dispose()


@pytest.fixture
def capture(worker: Worker, tmp_path: Path) -> str:
    """A stored capture of noise; its id."""
    return stored_files(worker.store, small_capture(tmp_path / "capture"), bytes=500)


def request(capture: str, mode: str | None = None) -> JobRequest:
    return {"capture_id": capture, "model": None, "settings": {} if mode is None else {"front": mode}}


def events_of(worker: Worker) -> list[dict[str, Any]]:
    return [dict(event.document) for event in worker.events.since(JOB, 0)]


def test_a_job_begins_with_its_capture_and_disk_space(
    worker: Worker, capture: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker.ingest(JOB, request(capture))
    assert worker.store.folder("jobs", JOB).is_dir()
    assert events_of(worker) == [{"state": "running", "stage": "ingest", "progress": 0.0, "eta_s": None}]
    with pytest.raises(JobFailed) as gone:
        worker.ingest(JOB, request(new_id()))
    assert gone.value.kind == "not-found"
    monkeypatch.setattr(Store, "free_bytes", lambda self: 1500)  # the capture's 500 bytes beside the 1,000 to leave
    worker.ingest(JOB, request(capture))
    monkeypatch.setattr(Store, "free_bytes", lambda self: 1499)
    with pytest.raises(JobFailed) as full:
        worker.ingest(JOB, request(capture))
    assert full.value.kind == "disk-full"


def test_a_job_without_a_folder_says_so(worker: Worker, capture: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Path, *positional: Any, **named: Any) -> None:
        raise OSError(30, "Read-only file system", str(self))

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(JobFailed) as unwritable:
        worker.ingest(JOB, request(capture))
    assert unwritable.value.kind == "data-unwritable"


def test_a_fit_is_published_once_whoever_publishes_it(worker: Worker, capture: str) -> None:
    worker.ingest(JOB, request(capture))
    attempts = []
    for _ in range(2):
        before = len(events_of(worker))
        attempts.append(worker.fit(JOB, request(capture)))
        shares = [event["progress"] for event in events_of(worker)[before:]]
        assert shares == sorted(shares), "progress never goes back within an attempt"
    first, second = attempts
    folder = worker.store.folder("jobs", JOB)
    assert {path.name for path in folder.iterdir()} == {first, second}
    files = worker.publish(JOB, first)
    assert files.keys() == {"head.ply", "head.glb", "overlays/cam00.png"}
    assert {path.name for path in folder.iterdir()} == {"result"}, "other attempts are swept"
    assert worker.publish(JOB, second) == files, "another worker had published it"
    assert files == described(folder / "result")


@pytest.mark.parametrize("mode", ["killed once", "killed below photo", "short below photo"])
def test_work_that_the_system_kills_is_done_again_and_with_less(worker: Worker, capture: str, mode: str) -> None:
    worker.ingest(JOB, request(capture))
    worker.publish(JOB, worker.fit(JOB, request(capture, mode)))
    report = worker.store.folder("jobs", JOB) / "result" / "report.json"
    assert [warning["code"] for warning in warnings_of(report)[2:]] == ["level-lowered"] * ("below" in mode)


def test_an_end_waits_for_the_database_and_is_written_once(worker: Worker) -> None:
    refused = list[int]()

    @event.listens_for(worker.engine, "before_cursor_execute")
    def refuse(*_: object) -> None:
        if len(refused) < 2:
            refused.append(1)
            raise OperationalError("INSERT", None, ConnectionRefusedError("away"))

    for _ in range(2):  # the worker is killed before the engine knows of the end; the next one repeats it
        worker.outcomes.publish(JOB, "failed", failure="no-subject")
    assert len(refused) == 2
    assert events_of(worker) == [{"state": "failed"}]
    assert failure_counts(worker.engine) == {"no-subject": 1}


@pytest.mark.parametrize("text", [None, "", "[]", "{}", '{"warnings": 3'])
def test_a_report_that_cannot_be_read_has_no_warnings(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "report.json").write_text(text)
    assert warnings_of(tmp_path / "report.json") == []


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (OSError(28, "No space left on device"), "disk-full"),
        (OSError(30, "Read-only file system"), "data-unwritable"),
        (InputError("cameras.json", ["cameras.json: no camera"]), "invalid-cameras"),
        (WorkFailed("NoSubject", "No subject was found."), "no-subject"),
        (WorkFailed("NobodyKnowsThis", "?"), "eigenhead-error"),
    ],
)
def test_each_cause_has_its_kind(error: BaseException, kind: str) -> None:
    found = failure_of(error)
    assert isinstance(found, JobFailed)
    assert found.kind == kind


def test_what_is_no_failure_of_the_job_is_left_to_the_engine() -> None:
    for error in (Cancelled(), OSError(5, "Input/output error"), KeyboardInterrupt()):
        assert failure_of(error) is error


@pytest.fixture
def stopping(tmp_path: Path, engine: Engine) -> Iterator[Worker]:
    """A worker whose stores are not mounted."""
    away = f"file://{tmp_path}/away/"
    stores: dict[str, Any] = {"results_store": away, "deliver_prefixes": (away,)}
    worker = Worker(ServiceSettings(data=tmp_path / "data", poll_s=100.0, **stores))
    yield worker
    worker._children.close()
    worker.engine.dispose()


@pytest.mark.parametrize("waits_for", ["the job", "the place", "the results' store"])
def test_a_worker_that_stops_ends_what_waits_and_fails_nothing(
    stopping: Worker, engine: Engine, tmp_path: Path, waits_for: str
) -> None:
    if waits_for == "the place":
        engine.status = "SUCCESS"
        engine.output = {"head.ply": {"bytes": 1, "sha256": hashlib.sha256(b"x").hexdigest()}}
    (result := stopping.store.folder("jobs", JOB) / "result").mkdir(parents=True)
    (result / "head.ply").write_bytes(b"x")
    wanted: DeliveryRequest = {"job_id": JOB, "to": f"file://{tmp_path}/away/", "until": time.time() + 3600}
    ended = list[BaseException | None]()

    def step() -> None:
        try:
            stopping.publish(JOB, "attempt-1") if waits_for == "the results' store" else stopping._deliverer.deliver(
                wanted
            )
        except BaseException as error:
            ended.append(error)

    thread = threading.Thread(target=step, daemon=True)
    thread.start()
    time.sleep(0.2)
    assert not ended
    stopping.stop()
    thread.join(60.0)
    assert not thread.is_alive()
    assert not isinstance(ended[0], Exception), "the engine would note it as a failure"


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

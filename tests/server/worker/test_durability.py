"""What SIGKILL at any moment may not do: lose a job, run it to two ends, or change a byte of its result."""

import hashlib
import os
import random
import signal
import sqlite3
import struct
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from psycopg.errors import LockNotAvailable
from sqlalchemy.exc import OperationalError

from server.settings import ServiceSettings
from tests.support.attacks import process_tree
from tests.support.postgres import running_postgres
from tests.support.services import (
    ROOT,
    RunningService,
    await_state,
    await_true,
    kill_workers,
    packed,
    running_service,
    served_client,
    small_capture,
    uploaded_capture,
    worker_pids,
)

NIGHTLY = pytest.mark.nightly


@contextmanager
def database(kind: str) -> Iterator[dict[str, Any]]:
    if kind == "sqlite":
        yield {}
        return
    with running_postgres() as url:
        yield {"database_url": url}


def submit(service: RunningService, capture: str, number: int, settings: dict[str, Any] | None = None) -> str:
    """Until it is accepted, as a client does: the key makes it one job."""
    deadline = time.monotonic() + 60
    while True:
        try:
            response = httpx.post(
                service.url + "/v1/jobs",
                json={"capture_id": capture, "settings": settings},
                headers={"Idempotency-Key": f"job {number}"},
                timeout=10,
            )
            if response.status_code == 202:
                return response.json()["id"]
        except httpx.TransportError:
            pass
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
@pytest.mark.parametrize(("total", "kills"), [(12, 4), pytest.param(100, 30, marks=NIGHTLY)])
def test_jobs_survive_kills(kind: str, total: int, kills: int, tmp_path: Path) -> None:
    """In turn a worker, the child that does its work, the service, and PostgreSQL, which then restarts itself."""
    rng = random.Random(20240501)
    with (
        database(kind) as settings,
        running_service(tmp_path / "data", silent_s="5", tiny_s="0.3", jobs_per_key="1000", **settings) as service,
    ):
        capture = uploaded_capture(service, tmp_path)
        jobs = [submit(service, capture, 0)]
        with httpx.Client(base_url=service.url) as client:
            undisturbed = await_state(client, jobs[0], ("succeeded",), 60)["files"]
        jobs += [submit(service, capture, number) for number in range(1, total // 2)]
        for number in range(kills):
            time.sleep(rng.uniform(0.2, 2.0))
            if number < total // 2:
                jobs.append(submit(service, capture, total // 2 + number))
            if number % 4 == 2:
                service.kill()
                service.start()
            elif number % 4 == 3 and settings:
                kill_a_session(settings["database_url"])
            else:
                for pid in worker_pids(service):
                    for victim in children_of(pid) if number % 4 == 1 else [pid]:
                        os.kill(victim, signal.SIGKILL)
        jobs += [submit(service, capture, number) for number in range(total // 2 + kills, total)]
        assert len(set(jobs)) == total
        with httpx.Client(base_url=service.url, timeout=30) as client:
            ended = [await_state(client, job, ("succeeded", "failed", "cancelled"), 240) for job in jobs]
            assert [(job["state"], job["files"]) for job in ended] == [("succeeded", undisturbed)] * total
            assert [job["finished"] for job in ended] == sorted(job["finished"] for job in ended), "places are kept"
            listed = client.get("/v1/jobs", params={"limit": 1000}).json()["jobs"]
        assert sorted(job["id"] for job in listed) == sorted(jobs)
        heads = {
            hashlib.sha256((service.data / "jobs" / job / "result/head.ply").read_bytes()).hexdigest() for job in jobs
        }
        assert heads == {undisturbed["head.ply"]["sha256"]}
        assert not [path for job in jobs for path in (service.data / "jobs" / job).glob("attempt-*")]


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("total", "kills"), [(2, 2), pytest.param(5, 4, marks=NIGHTLY)])
def test_real_heads_survive_kills_to_the_last_byte(total: int, kills: int, tmp_path: Path) -> None:
    """Reconstructions of a simulated shot, SIGKILLs into one that runs: every second one takes the service, too.
    report.json tells times of its own; every other file is the undisturbed one."""
    rng = random.Random(4)
    with served_client(tmp_path / "data", work="server.tasks.reconstruct:reconstruct_capture", silent_s="5") as (
        service,
        client,
    ):
        shots = [client.post("/v1/captures", json={"seed": 1}).json() for _ in range(2)]
        assert shots[0]["inputs"] == shots[1]["inputs"], "a seed is one subject"
        capture = shots[0]["id"]
        settings = {"detail": "span", "outputs": {"surface": "head"}}
        first = submit(service, capture, 0, settings)
        undisturbed = files_of(await_state(client, first, ("succeeded", "failed"), 240))
        assert {"head.ply", "head.glb", "contact_sheet.png"} <= undisturbed.keys()
        jobs = [submit(service, capture, number, settings) for number in range(1, total + 1)]
        for number in range(kills):
            await_true(lambda: any(client.get(f"/v1/jobs/{j}").json()["state"] == "running" for j in jobs), 60)
            time.sleep(rng.uniform(0.2, 3.0))
            if number % 2:
                service.kill()
            kill_workers(service)
            if number % 2:
                service.start()
        ended = [await_state(client, job, ("succeeded", "failed", "cancelled"), 240) for job in jobs]
        assert [job["state"] for job in ended] == ["succeeded"] * total
        assert [files_of(job) for job in ended] == [undisturbed] * total


def children_of(worker: int) -> list[int]:
    """Processes below a worker that do jobs' work: not what the tests start them with."""
    found = []
    for pid in process_tree(worker)[1:]:
        with suppress(OSError):  # it has ended
            found += [pid] if b"tasks.child" in Path(f"/proc/{pid}/cmdline").read_bytes() else []
    return found


def kill_a_session(url: str) -> None:
    """SIGKILL of one of PostgreSQL's processes: the server then ends all of them and recovers from its log."""
    engine = sa.create_engine(ServiceSettings(database_url=url).url)
    with suppress(OperationalError), engine.connect() as connection:  # this one ends, too
        mine = "datname IS NOT NULL AND pid != pg_backend_pid()"
        os.kill(connection.scalar(sa.text(f"SELECT pid FROM pg_stat_activity WHERE {mine} LIMIT 1")), signal.SIGKILL)
    engine.dispose()


def files_of(job: dict[str, Any]) -> dict[str, str]:
    """sha256 of a job's files, without what tells how long it took."""
    return {name: file["sha256"] for name, file in job["files"].items() if name != "report.json"}


@contextmanager
def own_worker(service: RunningService) -> Iterator["subprocess.Popen[bytes]"]:
    """A worker that no service started."""
    environment = os.environ | service.environment | {"EIGENHEAD_DATA": str(service.data)}
    with service.log.open("ab") as log:
        command = [sys.executable, "-m", "server.cli", "worker"]
        process = subprocess.Popen(command, env=environment, cwd=ROOT, stderr=log)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def stop_between_writes(process: "subprocess.Popen[bytes]", sqlite: Path | None) -> None:
    """SIGSTOP, at a moment when the process does not hold SQLite's one write lock (docs/service.md says why)."""
    deadline = time.monotonic() + 20
    while True:
        process.send_signal(signal.SIGSTOP)
        if sqlite is None:
            return
        with closing(sqlite3.connect(sqlite, timeout=0.5)) as probe:
            try:
                probe.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError:
                process.send_signal(signal.SIGCONT)
            else:
                return
        assert time.monotonic() < deadline
        time.sleep(0.01)


@contextmanager
def open_transaction(settings: dict[str, Any], job: str) -> Iterator[None]:
    """On PostgreSQL, a session that locked the job's row and says no more: one of ours, or the stopped worker's own
    where it was stopped with the lock. Not one after the other: each of them would be waited for."""
    if not settings:
        yield
        return
    engine = sa.create_engine(ServiceSettings(**settings).url)
    connection = engine.connect()
    query = "SELECT status FROM dbos.workflow_status WHERE workflow_uuid = :job FOR NO KEY UPDATE NOWAIT"
    try:
        assert connection.scalar(sa.text(query), {"job": job}) == "PENDING"
    except OperationalError as error:
        if not isinstance(error.orig, LockNotAvailable):
            raise
    try:
        yield
    finally:
        connection.invalidate()  # the server has ended it
        engine.dispose()


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_the_job_of_a_worker_that_never_returns_is_taken_over_within_30_s(kind: str, tmp_path: Path) -> None:
    """Both workers here are on this machine, where a dead process is noticed at once; to test the silence that another
    machine would see, the first is stopped (SIGSTOP), which looks alive to everything but its heartbeat. On PostgreSQL
    a session beside it stays inside a transaction on the job's row, as that of a host that lost its power would."""
    with (
        database(kind) as settings,
        served_client(tmp_path / "data", worker=False, tiny_s="3", **settings) as (service, client),
    ):
        capture = uploaded_capture(service, tmp_path)
        with own_worker(service) as first:
            job = submit(service, capture, 0)
            await_state(client, job, ("running",))
            stop_between_writes(first, service.data / "eigenhead.sqlite" if kind == "sqlite" else None)
            stopped = time.monotonic()
            with open_transaction(settings, job), own_worker(service):
                await_state(client, job, ("succeeded",), 40)
                taken_s = time.monotonic() - stopped
            assert taken_s < 30 + 3
            first.send_signal(signal.SIGCONT)  # it comes back, finds its job done by another, and does no harm
            time.sleep(5)
            assert client.get(f"/v1/jobs/{job}").json()["state"] == "succeeded"
            again = submit(service, capture, 1)
            assert await_state(client, again, ("succeeded",))["files"] == client.get(f"/v1/jobs/{job}").json()["files"]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_jobs_end_by_any_clock(tmp_path: Path) -> None:
    """Of three jobs one waits over a restart with a clock of 60 days ahead, one ends by it, and the clock goes back by
    120 days while one runs. The monotonic clock is the system's."""
    clock, library = tmp_path / "clock", tmp_path / "clock.so"
    source = ROOT / "tests" / "support" / "shifted_clock.c"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    days = struct.Struct("=q").pack
    settings = {"keep_captures_days": "30", "keep_results_days": "30", "tiny_s": "1.5"}
    with served_client(tmp_path / "data", sweep_s="1", **settings) as (service, client):
        capture = uploaded_capture(service, tmp_path)
        undisturbed = await_state(client, submit(service, capture, 0), ("succeeded",))["files"]
        jobs = [submit(service, capture, 1)]
        service.stop()
        service.environment |= {"LD_PRELOAD": str(library), "CLOCK_SHIFT": str(clock)}
        service.forked = False
        clock.write_bytes(days(60 * 86400))
        service.start()
        assert "clock" in client.get("/readyz").json()["checks"]["retention"]["detail"]
        jobs.append(submit(service, capture, 2))
        await_state(client, jobs[1], ("succeeded", "failed"), 60)
        jobs.append(submit(service, capture, 3))
        await_state(client, jobs[2], ("running",), 60)
        with clock.open("r+b") as file:  # never empty: the service has it mapped
            file.write(days(-60 * 86400))
        ended = [await_state(client, job, ("succeeded", "failed"), 60) for job in jobs]
        assert [(job["state"], job["files"]) for job in ended] == [("succeeded", undisturbed)] * 3
        time.sleep(2.0)  # two sweeps
        assert [client.get(f"/v1/{kind}").json()["total"] for kind in ("captures", "jobs")] == [1, 4]


def test_data_of_an_earlier_version_are_opened_and_its_jobs_end(tmp_path: Path) -> None:
    """The data folder of a service of commit 3ee27d5, killed while one job was done, one ran and one waited; its rows
    are pickled."""
    with tarfile.open(Path(__file__).with_name("data_of_version_3ee27d5.tar.xz")) as archive:
        archive.extractall(tmp_path / "data", filter="data")
    with served_client(tmp_path / "data") as (service, client):
        listed = client.get("/v1/jobs", params={"sort": "created"}).json()["jobs"]
        ended = [await_state(client, job["id"], ("succeeded", "failed"), 60) for job in listed]
        assert [job["state"] for job in ended] == ["succeeded"] * 3
        assert ended[0] == listed[0]
        for job in ended:
            assert job["files"] == ended[0]["files"]
            for name, file in job["files"].items():
                body = client.get(f"/v1/jobs/{job['id']}/result/{name}").content
                assert hashlib.sha256(body).hexdigest() == file["sha256"]
        assert submit(service, ended[0]["capture_id"], 0) not in {job["id"] for job in listed}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_killed_uploads_and_restarts_keep_what_was_accepted(tmp_path: Path) -> None:
    """The service is killed while uploads run; every accepted capture is there afterwards, whole, and no other."""
    with running_service(tmp_path / "data", worker=False) as service:
        data, accepted, rng = packed(small_capture(tmp_path / "capture")), [], random.Random(1)
        for _ in range(6):
            killer = subprocess.Popen(["sleep", str(rng.uniform(0.05, 1.0))])
            while killer.poll() is None:
                try:
                    response = httpx.post(service.url + "/v1/captures/uploads", files={"file": data}, timeout=5)
                    accepted.append(response.json()["id"])
                except httpx.TransportError:
                    break
                if len(accepted) % 3 == 0 and killer.poll() is not None:
                    break
            service.kill()
            service.start()
        captures = httpx.get(service.url + "/v1/captures").json()["captures"]
        assert {capture["id"] for capture in captures} >= set(accepted)
        for capture in captures:
            for name, digest in capture["inputs"].items():
                path = service.data / "captures" / capture["id"] / "files" / name
                assert hashlib.sha256(path.read_bytes()).hexdigest() == digest


def test_a_damaged_record_is_set_aside_and_reported_and_strangers_files_stay(tmp_path: Path) -> None:
    with running_service(tmp_path / "data", worker=False, sweep_s="0.2") as service:
        kept, damaged = (uploaded_capture(service, tmp_path, seed) for seed in (1, 2))
        (service.data / "captures" / damaged / "record.json").write_text('{"format": "eigenhead-capt')
        (service.data / "captures" / "mine").mkdir()
        (service.data / "captures" / "mine" / "notes.txt").write_text("not yours")
        (service.data / "incoming" / "notes.txt").write_text("not yours")
        captures = httpx.get(service.url + "/v1/captures").json()["captures"]
        assert [capture["id"] for capture in captures] == [kept]
        assert httpx.get(f"{service.url}/v1/captures/{damaged}").status_code == 404
        aside = [path.name for path in (service.data / "set-aside").iterdir()]
        assert [damaged in name for name in aside] == [True]
        assert damaged in httpx.get(service.url + "/readyz", timeout=30).json()["checks"]["records"]["detail"]
        time.sleep(0.6)
        assert (service.data / "captures" / "mine" / "notes.txt").read_text() == "not yours"
        assert (service.data / "incoming" / "notes.txt").read_text() == "not yours"
        assert "eigenhead_damaged_records 1.0" in httpx.get(service.url + "/metrics").text

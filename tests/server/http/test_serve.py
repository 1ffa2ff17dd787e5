"""``eigenhead serve`` and signals that reach the whole process group: the worker and its child, too."""

import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx

from tests.support.attacks import add_keys
from tests.support.services import (
    ROOT,
    RunningService,
    await_state,
    await_true,
    running_service,
    uploaded_capture,
    worker_pids,
)


def test_a_signal_to_the_whole_group_ends_both_without_a_word_of_dying(tmp_path: Path) -> None:
    """As `timeout`, a container's runtime or a supervisor sends it."""
    with running_service(tmp_path / "data", forked=False) as service:
        assert service.process is not None
        await_true(lambda: "worker ready" in service.log_end())
        os.killpg(service.process.pid, signal.SIGTERM)
        service.process.wait(120)
        assert worker_pids(service) == []
        assert "worker stopped" in service.log_end()
        assert "worker died" not in service.log_end()


def test_a_lost_database_is_told_and_opens_nothing(tmp_path: Path) -> None:
    """Gone, emptied, damaged: a sentence each. Without keys the service starts, and names what it does not know."""
    with running_service(tmp_path / "data", sweep_s="0.3") as service:
        with httpx.Client(base_url=service.url, timeout=30) as client:
            job = client.post("/v1/jobs", json={"capture_id": uploaded_capture(service, tmp_path)}).json()["id"]
            await_state(client, job, ("succeeded",))
        service.stop()
        database = service.data / "eigenhead.sqlite"
        whole = database.read_bytes()
        for damaged in (b"no database at all " * 999, whole[:8192] + bytes(len(whole) - 8192)):
            database.write_bytes(damaged)
            assert "cannot be used" in refusal(service)
            assert "restore a copy" in refusal(service)
        database.write_bytes(b"")
        service.start()
        await_true(lambda: job in httpx.get(service.url + "/readyz").json()["checks"]["results"]["detail"])
        add_keys(service, "admin")
        service.stop()
        service.start()  # which notes that there are keys
        service.stop()
        database.unlink()
        assert "had some, and the database" in refusal(service)


def refusal(service: RunningService) -> str:
    """What a start says that fails, in one line without a traceback."""
    command = [sys.executable, "-m", "server.cli", "serve", "--data", str(service.data), "--port", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1), done.stderr
    return done.stderr


def test_ctrl_c_stops_service_and_worker_once_and_the_job_goes_on_later(tmp_path: Path) -> None:
    keyboard, terminal = pty.openpty()
    with running_service(tmp_path / "data", terminal=terminal, tiny_s="4", silent_s="5") as service:
        assert service.process is not None
        with httpx.Client(base_url=service.url, timeout=30) as client:
            job = client.post("/v1/jobs", json={"capture_id": uploaded_capture(service, tmp_path)}).json()["id"]
            await_state(client, job, ("running",))
            time.sleep(0.5)  # the worker's child has the work
            os.write(keyboard, b"\x03")
            assert service.process.wait(120) == 130
        log = service.log.read_text()
        assert log.count("worker ready") == log.count("worker stopped") == 1
        assert not [line for line in log.splitlines() if "died" in line or "Traceback" in line or "failed" in line]
        assert worker_pids(service) == []
        service.start()
        with httpx.Client(base_url=service.url, timeout=30) as client:
            assert await_state(client, job, ("succeeded", "failed", "cancelled"))["state"] == "succeeded"
    os.close(keyboard)
    os.close(terminal)

"""``eigenhead batch``: usage, status and what is printed; the work itself is pinned."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from server.batch import run as batch_run
from server.cli.main import app
from tests.support.pinned_batch import pinned_capture, pinned_captures
from tests.support.pinned_work import LOG, SECONDS, work
from tests.support.services import ROOT, await_true


@pytest.fixture
def shots(tmp_path: Path) -> Path:
    return pinned_captures(tmp_path / "shots", 3)


@pytest.fixture(autouse=True)
def _pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    real = batch_run.BatchRun

    def pinned(*positional: Any, **named: Any) -> batch_run.BatchRun:
        return real(*positional, **named, work=work)

    monkeypatch.setattr(batch_run, "BatchRun", pinned)
    monkeypatch.setattr("server.tasks.prepare.prepare_kernels", lambda report, settings=None: None)


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["batch", *map(str, arguments)])


def message_of(result: Result) -> str:
    return " ".join(result.stderr.replace("│", " ").split())


def test_status_0_and_where_the_table_lies(shots: Path, tmp_path: Path) -> None:
    done = invoke(shots, "--out", tmp_path / "heads", "--workers", 2)
    assert done.exit_code == 0
    files = [str(tmp_path / "heads" / name) for name in ("heads.csv", "heads.parquet", "sheet.html", "sheet.pdf")]
    assert done.stdout.splitlines() == [*files, "3 made, 0 kept, 0 failed"]
    assert "3 of 3: " in done.stderr
    again = invoke(shots, "--out", tmp_path / "heads", "--json")
    document = json.loads(again.stdout)
    assert {key: document[key] for key in ("captures", "made", "kept", "failed", "shard")} == {
        "captures": 3, "made": 0, "kept": 3, "failed": 0, "shard": "1/1",
    }  # fmt: skip
    assert again.stderr == ""


def test_status_1_names_what_failed(shots: Path, tmp_path: Path) -> None:
    pinned_capture(shots / "bad", 4, "fail")
    done = invoke(shots, "--out", tmp_path / "heads", "--json")
    assert done.exit_code == 1
    assert "eigenhead: bad: capture: the row names no capture; the list names no capture" in done.stderr.splitlines()
    assert done.stderr.splitlines()[-1] == "eigenhead: 1 capture of 4 failed: bad"
    (failure,) = json.loads(done.stdout)["failures"]
    assert (failure["capture"], failure["kind"], failure["code"]) == ("bad", "input", "input-refused")
    assert [fault["code"] for fault in failure["faults"]] == ["batch-capture-unnamed", "batch-list-empty"]


def test_status_2_for_a_list_with_every_fault_of_it(shots: Path, tmp_path: Path) -> None:
    (tmp_path / "study.csv").write_text(
        'capture,settings\nshots/s0000,"{""detial"": 1}"\nshots/s0001,"{""front"": 3}"\n'
    )
    done = invoke(tmp_path / "study.csv", "--out", tmp_path / "heads")
    assert done.exit_code == 2
    assert "shots/s0000: " in message_of(done)
    assert "shots/s0001: " in message_of(done)


def test_results_never_lie_within_a_capture(shots: Path) -> None:
    done = invoke(shots, "--out", shots / "s0000" / "heads")
    assert done.exit_code == 2
    assert "lies within the capture s0000" in message_of(done)


def test_results_of_another_version_stay_and_are_told(shots: Path, tmp_path: Path) -> None:
    invoke(shots, "--out", tmp_path / "heads")
    record = tmp_path / "heads" / "s0001" / "batch.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"version": "0.0.1"}))
    done = invoke(shots, "--out", tmp_path / "heads", "--json")
    assert json.loads(done.stdout)["kept"] == 3
    assert "1 result of another version was kept" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_scheduler_and_ctrl_c_end_it_and_leave_nothing(shots: Path, tmp_path: Path, number: int) -> None:
    out, log = tmp_path / "heads", tmp_path / "log"
    script = (  # without a terminal a shell has its background ignore SIGINT, and what that starts, too
        "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from server.batch import run\nfrom tests.support.pinned_work import work\nreal = run.BatchRun\n"
        "run.BatchRun = lambda *a, **n: real(*a, **n, work=work)\nfrom server.cli.main import main\nmain()"
    )
    command = [sys.executable, "-c", script, "batch", str(shots), "--out", str(out), "--workers", "2"]
    environment = os.environ | {SECONDS: "60", LOG: str(log)}
    with subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE) as running:
        await_true(lambda: not (not log.exists() or log.read_text().count("begins") < 2), 60)
        children = [int(line.split()[3]) for line in log.read_text().splitlines()]
        running.send_signal(number)
        assert running.communicate(timeout=45)[1].endswith(b"eigenhead: Stopped; nothing was written\n")
        assert running.returncode == 130
    assert not out.exists()
    assert not [child for child in children if Path(f"/proc/{child}").exists()]

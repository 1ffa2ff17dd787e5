"""``eigenhead batch``: usage, status and what is printed; the work itself is pinned."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from rig.render.renderer import Renderer
from server.batch import run as batch_run
from server.cli.main import app
from tests.support.pinned_batch import everything_in, pinned_capture, pinned_captures
from tests.support.pinned_work import LOG, SECONDS, work
from tests.support.services import ROOT, await_true
from tests.support.small_studio import small_studio_captures


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
    assert "eigenhead: bad: capture: names no capture; names no capture" in done.stderr.splitlines()
    assert done.stderr.splitlines()[-1] == "eigenhead: 1 capture of 4 failed: bad"
    (failure,) = json.loads(done.stdout)["failures"]
    assert (failure["capture"], failure["kind"], failure["code"]) == ("bad", "input", "input-refused")
    assert [fault["code"] for fault in failure["faults"]] == ["batch-capture-unnamed", "batch-list-empty"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--shard", "9/8"], "is no share such as 2/8"),
        (["--workers", "0"], "--workers"),
        (["--detail", "deep"], "'deep' is not one of 'span', 'kernel', 'photo', 'fine', 'pores'"),
        (["--formats", "fbx"], "'fbx' is none of"),
    ],
)
def test_status_2_for_wrong_options(shots: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    done = invoke(shots, "--out", tmp_path / "heads", *arguments)
    assert done.exit_code == 2
    assert words in message_of(done)
    assert not (tmp_path / "heads").exists()


def test_status_2_for_a_list_with_every_fault_of_it(shots: Path, tmp_path: Path) -> None:
    (tmp_path / "study.csv").write_text(
        'capture,settings\nshots/s0000,"{""detial"": 1}"\nshots/s0001,"{""front"": 3}"\n'
    )
    done = invoke(tmp_path / "study.csv", "--out", tmp_path / "heads")
    assert done.exit_code == 2
    assert "shots/s0000: " in message_of(done)
    assert "shots/s0001: " in message_of(done)
    (tmp_path / "study.csv").write_text("capture\ngone\nlost\n")
    done = invoke(tmp_path / "study.csv", "--out", tmp_path / "heads")
    assert done.exit_code == 2
    assert "line 2: " in message_of(done)
    assert "line 3: " in message_of(done)


def test_results_never_lie_within_a_capture(shots: Path) -> None:
    done = invoke(shots, "--out", shots / "s0000" / "heads")
    assert done.exit_code == 2
    assert "lies within the capture s0000" in message_of(done)


def test_shards_share_the_captures_out(shots: Path, tmp_path: Path) -> None:
    counts = [
        json.loads(invoke(shots, "--out", tmp_path / "heads", "--shard", f"{k}/2", "--json").stdout)["made"]
        for k in (1, 2)
    ]
    assert sum(counts) == 3


def test_results_of_another_version_stay_and_are_told(shots: Path, tmp_path: Path) -> None:
    invoke(shots, "--out", tmp_path / "heads")
    record = tmp_path / "heads" / "s0001" / "batch.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"version": "0.0.1"}))
    done = invoke(shots, "--out", tmp_path / "heads", "--json")
    assert json.loads(done.stdout)["kept"] == 3
    assert "1 result is of another version and stays" in done.stderr


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
        assert running.wait(45) == 130
    assert list(out.iterdir()) == []
    assert not [child for child in children if Path(f"/proc/{child}").exists()]


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(900)
def test_real_heads_survive_kills_to_the_last_byte(tmp_path: Path, renderer: Renderer) -> None:
    """Two heads of the studio by one worker, the command as it is typed, SIGKILL thrice while it is at work."""
    rng = random.Random(37)
    shots = small_studio_captures(tmp_path / "shots", 2, renderer)
    command = [sys.executable, "-m", "server.cli", "batch", str(shots), "--detail", "span", "--surface", "head"]

    def run(out: Path) -> "subprocess.Popen[bytes]":
        return subprocess.Popen([*command, "--workers", "1", "--out", str(out)], cwd=ROOT, stdout=subprocess.DEVNULL)

    began = time.monotonic()
    with run(tmp_path / "undisturbed" / "heads") as whole:
        assert whole.wait(240) == 0
    seconds, out, left = time.monotonic() - began, tmp_path / "heads", []
    for _ in range(3):
        with run(out) as running:
            time.sleep(rng.uniform(0.3, 0.8) * seconds)
            running.kill()
        left.append(sorted(path.name for path in out.iterdir()))
    with run(out) as last:
        assert last.wait(240) == 0
    assert everything_in(out) == everything_in(tmp_path / "undisturbed" / "heads")
    assert any(".batch" in names for names in left)  # one of them at least was hit at work

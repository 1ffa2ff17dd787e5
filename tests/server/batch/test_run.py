"""A batch at work: every capture ends once, whatever happens to workers, to this process or to others."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from server.batch.captures import Shard
from server.batch.folder import ShareTaken
from server.batch.run import WORKER_BYTES, free_memory, threads_of_worker, usable_cores, worker_count
from tests.support.pinned_batch import Silent, everything_in, pinned_capture, pinned_captures, run_pinned
from tests.support.pinned_work import LOG, SECONDS
from tests.support.services import ROOT, await_true

COMMAND = [sys.executable, "-m", "tests.support.pinned_batch"]


def states(outcomes: list) -> dict[str, str]:
    return {outcome.name: outcome.state for outcome in outcomes}


def test_each_capture_becomes_a_folder_and_a_second_run_makes_nothing(tmp_path: Path) -> None:
    shots, out = pinned_captures(tmp_path / "shots", 3), tmp_path / "heads"
    assert states(run_pinned(shots, out)) == {"s0000": "made", "s0001": "made", "s0002": "made"}
    names = {path.relative_to(out).as_posix() for path in out.rglob("*")}
    assert {"heads.csv", "heads.parquet", "sheet.html", "sheet.pdf", "s0001/head.ply", "s0001/batch.json"} <= names
    assert not [name for name in names if name.startswith(".")]
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/*")}
    observer = Silent()
    assert set(states(run_pinned(shots, out, observer=observer)).values()) == {"kept"}
    assert (observer.pending, observer.events) == (0, [])
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/*")} == before


def test_another_input_or_setting_and_a_lost_file_are_made_again_and_the_rest_is_kept(tmp_path: Path) -> None:
    shots, out = pinned_captures(tmp_path / "shots", 3), tmp_path / "heads"
    run_pinned(shots, out)
    (shots / "s0000" / "images" / "seed.txt").write_text("77\n")
    (out / "s0001" / "head.ply").unlink()
    assert states(run_pinned(shots, out)) == {"s0000": "made", "s0001": "made", "s0002": "kept"}
    again = run_pinned(shots, out, settings={"detail": "span"})
    assert set(states(again).values()) == {"made"}
    assert not (out / ".batch").exists()


@pytest.mark.parametrize(
    ("mode", "kind", "words"),
    [
        ("fail", "input", "the row names no capture"),
        ("bug", "bug", "ZeroDivisionError: planted"),
        ("memory", "out-of-memory", "fewer --workers"),
        ("segfault", "crash", "signal 11"),
        ("killed", "crash", "fewer --workers"),
        ("changed", "input", "files changed during its reconstruction"),
    ],
)
def test_whatever_happens_to_one_capture_is_its_own_failure(tmp_path: Path, mode: str, kind: str, words: str) -> None:
    shots, out = pinned_captures(tmp_path / "shots", 2), tmp_path / "heads"
    pinned_capture(shots / "bad", 9, mode)
    outcomes = {outcome.name: outcome for outcome in run_pinned(shots, out, workers=1)}
    assert states([*outcomes.values()]) == {"bad": "failed", "s0000": "made", "s0001": "made"}
    failure = outcomes["bad"].failure
    assert failure is not None
    assert (failure.kind, words in failure.message.text) == (kind, True)
    assert ("planted" in failure.trace) == (mode == "bug")
    assert not (out / "bad").exists()
    assert [path.name for path in (out / ".batch").iterdir()] == ["failures"]
    row = next(line for line in (out / "heads.csv").read_text().splitlines() if line.startswith("bad,"))
    assert f",failed,{kind}," in row
    (shots / "bad" / "mode").unlink()
    assert states(run_pinned(shots, out))["bad"] == "made"
    assert not (out / ".batch").exists()


def test_files_that_somebody_laid_into_a_result_are_not_thrown_away(tmp_path: Path) -> None:
    shots, out = pinned_captures(tmp_path / "shots", 1), tmp_path / "heads"
    run_pinned(shots, out)
    (out / "s0000" / "notes.txt").write_text("mine")
    (shots / "s0000" / "images" / "seed.txt").write_text("5\n")
    (outcome,) = run_pinned(shots, out)
    assert outcome.failure is not None
    assert "notes.txt" in outcome.failure.message.text
    assert (out / "s0000" / "notes.txt").read_text() == "mine"


def test_shards_are_one_whole(tmp_path: Path) -> None:
    shots, out = pinned_captures(tmp_path / "shots", 7), tmp_path / "heads"
    shares = [states(run_pinned(shots, out, shard=Shard(k, 3))) for k in (1, 2, 3)]
    assert sorted(name for share in shares for name in share) == [f"s{k:04}" for k in range(7)]
    assert all(state == "made" for share in shares for state in share.values())
    assert (out / "heads.csv").read_text().count(",done,") == 7  # the last one's table has the others' heads


def test_shares_side_by_side_begin_nothing_twice_and_a_share_has_one_process(tmp_path: Path) -> None:
    shots, out, log = pinned_captures(tmp_path / "shots", 12), tmp_path / "heads", tmp_path / "log"
    environment = os.environ | {SECONDS: "0.15", LOG: str(log)}
    begun = []
    for share in ("1/2", "2/2"):
        command = [*COMMAND, str(shots), str(out), "2", share]
        begun.append(subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE))
        await_true((out / ".batch" / f"{share.replace('/', '-of-')}.lock").exists, 60)
    with pytest.raises(ShareTaken, match="share 1/2"):
        run_pinned(shots, out, shard=Shard(1, 2))
    printed = [json.loads(process.communicate(timeout=120)[0]) for process in begun]
    states_of_all = [state for states in printed for state in states.values()]
    assert states_of_all == ["made"] * 12
    assert sorted(line.split()[2] for line in log.read_text().splitlines() if "begins" in line) == sorted(
        f"s{k:04}" for k in range(12)
    )
    assert (out / "heads.csv").read_text().count(",done,") == 12
    assert not (out / ".batch").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("processes", "kills"), [(1, 20), (2, 8)])
def test_kills_at_any_moment_change_no_byte(tmp_path: Path, processes: int, kills: int) -> None:
    """SIGKILL at random moments, to every process of the batch; then one run to its end."""
    rng = random.Random(20 + processes)
    shots = pinned_captures(tmp_path / "shots", 60)
    run_pinned(shots, tmp_path / "undisturbed" / "heads")
    out, log = tmp_path / "heads", tmp_path / "log"
    environment = os.environ | {SECONDS: "0.1", LOG: str(log)}
    command = [*COMMAND, str(shots), str(out), "2"]
    for _ in range(kills):
        quiet = {"cwd": ROOT, "env": environment, "stdout": subprocess.DEVNULL}
        shares = [f"{k + 1}/{processes}" for k in range(processes)]
        running = [subprocess.Popen([*command, share], **quiet) for share in shares]
        time.sleep(rng.uniform(0.0, 0.5))  # 60 captures take 3 s without a kill
        for process in running:
            process.send_signal(signal.SIGKILL)
            process.wait()
    last = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=240, check=True)
    assert set(json.loads(last.stdout).values()) <= {"made", "kept"}
    assert everything_in(out) == everything_in(tmp_path / "undisturbed" / "heads")
    ended = [line.split()[2] for line in log.read_text().splitlines() if "ends" in line]
    assert set(ended) == {f"s{k:04}" for k in range(60)}


GB = 1 << 30


@pytest.mark.parametrize(
    ("cores", "free_gb", "captures", "count"),
    [(8, 64, 100, 8), (64, 20, 100, 10), (8, 64, 3, 3), (2, 1, 100, 1), (1, 64, 0, 1)],
)
def test_workers_by_cores_memory_and_captures(cores: int, free_gb: int, captures: int, count: int) -> None:
    assert worker_count(cores, free_gb * GB, captures) == count


@pytest.mark.parametrize(("cores", "workers", "threads"), [(8, 8, 1), (8, 2, 4), (8, 3, 2), (2, 4, 1)])
def test_threads_fill_the_cores(cores: int, workers: int, threads: int) -> None:
    assert threads_of_worker(cores, workers) == threads


def test_a_schedulers_limit_counts_where_it_is_less(tmp_path: Path) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 33554432 kB\nMemAvailable: 16777216 kB\n")
    assert free_memory(meminfo, tmp_path) == 16 * GB
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text(f"{3 * GB}\n")
    assert free_memory(meminfo, tmp_path) == 16 * GB
    (tmp_path / "memory.max").write_text(f"{8 * GB}\n")
    assert free_memory(meminfo, tmp_path) == 5 * GB
    assert free_memory(tmp_path / "none", tmp_path) == WORKER_BYTES
    assert usable_cores() >= 1
    assert 0 < free_memory() < 1 << 60

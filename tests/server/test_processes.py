"""Processes of the service run this checkout's code, wherever they start."""

import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from rig.progress import Progress
from server.processes import process_identity, process_started, python_command, python_environment
from server.tasks.child import Child, WorkerContext
from server.tasks.egl import try_egl
from tests.support import fork_server
from tests.support.hostile_folder import hostile_folder
from tests.support.services import ROOT, await_true


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory and PYTHONPATH hold packages with the project's names."""
    marker = hostile_folder(tmp_path / "hostile")
    monkeypatch.chdir(tmp_path / "hostile")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "hostile"))
    return marker


def test_a_child_imports_nothing_from_the_working_directory_or_pythonpath(marker: Path) -> None:
    child = Child()
    try:
        child.remote(try_egl)()
    finally:
        child.close()
    assert not marker.exists()


def test_a_worker_and_the_checkouts_command_start_beside_foreign_packages(marker: Path) -> None:
    commands = (
        (python_command("cli", "worker"), python_environment()),
        ([str(Path(sys.executable).with_name("eigenhead"))], None),
    )
    for command, environment in commands:
        done = fork_server.run([*command, "--help"], 120.0, env=environment)
        assert done.returncode == 0, done.stderr
    assert not marker.exists()


def test_who_a_process_is() -> None:
    machine, host, pid, started = process_identity()
    assert (process_identity()[0], pid, bool(host)) == (machine, os.getpid(), True)
    assert process_started(pid) == started > 0
    gone = subprocess.Popen([sys.executable, "-c", ""])
    assert gone.wait() == 0
    assert process_started(gone.pid) == 0


CHILD = "import os, time\nfrom server.processes import end_with_parent\nend_with_parent({parent})\ntime.sleep(60)"
PARENT = """
import os, subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {child!r}.format(parent=os.getpid())])
print(child.pid, flush=True)
sys.stdin.read()
"""


def test_a_process_ends_with_the_one_that_started_it() -> None:
    """Also by SIGKILL, of which the parent can tell nobody; and where the parent was gone before."""
    command = [sys.executable, "-c", PARENT.format(child=CHILD)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        await_true(lambda: b"end_with_parent" in Path(f"/proc/{child}/cmdline").read_bytes())
        time.sleep(0.3)
        parent.kill()
    await_true(lambda: process_started(child) == 0)
    orphan = subprocess.run([sys.executable, "-c", CHILD.format(parent=1)], cwd=ROOT, timeout=120, check=False)
    assert orphan.returncode == 1


def test_a_child_has_the_variables_that_it_was_given() -> None:
    with closing(Child(variables={"EIGENHEAD_THREADS": "3"})) as child:
        assert child.remote(thread_variable)() == "3"


def thread_variable(context: WorkerContext, report: Progress) -> str:
    return os.environ["EIGENHEAD_THREADS"]


def test_freed_memory_is_given_back_when_a_stage_begins() -> None:
    """Below arrays that still live, where glibc keeps it."""
    done = subprocess.run(
        [sys.executable, "-c", FREEING], cwd=ROOT, capture_output=True, text=True, timeout=120, check=True
    )
    before, within, after = map(int, done.stdout.split())
    assert within == pytest.approx(before, abs=1.0)
    assert after < before - 20.0


FREEING = """
from pathlib import Path
from server.processes import share_one_heap, tidied

def held_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4 // 1024

share_one_heap()
arrays = [bytearray(100_000) for _ in range(400)]
arrays = arrays[::40]
report = tidied(lambda stage, share: print(held_mb()))
print(held_mb())
report("depth", 0.5)
report("fine", 0.0)
"""

"""Compiling ahead: everything once, and no harm where it is stopped, cannot be kept, or is done twice."""

import logging
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from pipeline.compute import kernel_list
from pipeline.compute.kernel_list import Kernel
from rig import jit as compiled
from server.processes import python_environment
from server.tasks.prepare import prepare_kernels
from tests.support.disks import small_disk

LINES = (
    "fusion.grid_kernels:grown bool[3C]",
    "texturing.view_selection_kernels:blend_views float32[2C] float32[3C] float64",
)


class Stopped(Exception):
    pass


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and a list of two loops."""
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(kernel_list, "listed_kernels", lambda dense: [Kernel.from_line(line) for line in LINES])
    compiled._warned().clear()
    return tmp_path / "cache" / "kernels"


def kept(folder: Path) -> set[str]:
    return {path.name.partition("-")[0] for path in folder.iterdir()}


@pytest.mark.slow
def test_what_is_missing_is_compiled_once_and_counted_aloud(folder: Path) -> None:
    reported: list[tuple[str, float]] = []
    assert prepare_kernels(lambda stage, share: reported.append((stage, share))) == (2, 0, 2)
    assert reported == [(f"compiling {done} of 2 loops", done / 2) for done in range(3)]
    assert {"grid_kernels.grown", "view_selection_kernels.blend_views"} <= kept(folder)
    reported.clear()
    assert prepare_kernels(lambda stage, share: reported.append((stage, share))) == (0, 0, 2)
    assert reported == []
    next(folder.glob("grid_kernels.grown-*")).unlink()
    assert prepare_kernels(lambda stage, share: None) == (1, 0, 2)


@pytest.mark.slow
def test_one_that_is_stopped_does_no_harm(folder: Path) -> None:
    def stop(stage: str, share: float) -> None:
        if share:
            raise Stopped

    with pytest.raises(Stopped):
        prepare_kernels(stop)
    for path in folder.iterdir():
        assert not path.name.startswith(".")
    assert prepare_kernels(lambda stage, share: None).known == 2
    assert prepare_kernels(lambda stage, share: None) == (0, 0, 2)


def test_a_folder_that_cannot_be_written_is_said_in_one_line(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder.parent.write_text("a file where the folder should be")
    with caplog.at_level(logging.WARNING):
        assert prepare_kernels(lambda stage, share: pytest.fail("compiles in vain")) == (0, 2, 2)
        assert prepare_kernels(lambda stage, share: pytest.fail("compiles in vain")) == (0, 2, 2)
    (line,) = caplog.messages
    assert line.startswith("compiled loops and arrays of head models are not kept in")


PREPARE_AND_USE = """
import sys
import numpy as np
from pipeline.compute import kernel_list
from pipeline.fusion.grid_kernels import grown
from pipeline.compute.array_cache import cached_arrays
from pipeline.compute.kernel_list import Kernel
from server.tasks.prepare import prepare_kernels

kernel_list.listed_kernels = lambda dense: [Kernel.from_line(line) for line in sys.argv[1:]]
print(*prepare_kernels(lambda stage, share: None), flush=True)
cached_arrays("some", [1], lambda: {"a": np.arange(99999)}, made_by=[])
cells = np.zeros((3, 3, 3), bool)
cells[1, 1, 1] = True
print(grown(cells).sum())
"""


def preparing(cache: Path, script: Path) -> "subprocess.Popen[str]":
    """A process that compiles ahead, keeps arrays, and calls a loop; it leads a group of its own."""
    script.write_text(PREPARE_AND_USE)
    return subprocess.Popen(
        [sys.executable, script, *LINES],
        env=python_environment() | {"EIGENHEAD_CACHE": str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def ended(process: "subprocess.Popen[str]") -> tuple[list[str], list[str]]:
    """Lines of standard output and error."""
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return out.splitlines(), errors.splitlines()


@pytest.mark.slow
def test_one_that_is_killed_leaves_nothing_that_others_stumble_over(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    killed = preparing(cache, tmp_path / "use.py")
    deadline = time.monotonic() + 60
    while not list(cache.glob("kernels/*")) and time.monotonic() < deadline:
        time.sleep(0.002)
    os.killpg(killed.pid, signal.SIGKILL)
    assert killed.wait(10) == -signal.SIGKILL
    killed.communicate()
    (numbers, count), _ = ended(preparing(cache, tmp_path / "use.py"))
    compiled_now, missing, known = map(int, numbers.split())
    assert (compiled_now > 0, missing, known) == (True, 0, 2)
    assert int(count) > 1
    (numbers, _), errors = ended(preparing(cache, tmp_path / "use.py"))
    assert numbers == "0 0 2"
    assert errors == []


@pytest.mark.slow
def test_two_processes_at_once_do_no_harm(tmp_path: Path) -> None:
    for process in [preparing(tmp_path / "cache", tmp_path / "use.py") for _ in range(2)]:
        (numbers, count), _ = ended(process)
        assert numbers.split()[1:] == ["0", "2"]
        assert int(count) > 1
    assert not list((tmp_path / "cache").rglob(".*"))
    assert ended(preparing(tmp_path / "cache", tmp_path / "use.py"))[0][0] == "0 0 2"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["full", "read-only", "no folder"])
def test_where_nothing_can_be_kept_the_work_is_done_and_one_line_says_so(tmp_path: Path, kind: str) -> None:
    with ExitStack() as stack:
        if kind == "no folder":
            (tmp_path / "home").write_text("a file where the folder should be")
            home = tmp_path / "home"
        else:
            home = stack.enter_context(small_disk(tmp_path / "home", 1, *(["ro"] if kind == "read-only" else [])))
        if kind == "full":
            (home / "ballast").write_bytes(bytes((1 << 20) - (16 << 10)))
        out, errors = ended(preparing(home / "cache", tmp_path / "use.py"))
        assert out[0] == "0 2 2"
        assert int(out[1]) > 1
        (line,) = errors
        assert line.startswith(f"compiled loops and arrays of head models are not kept in {home / 'cache'} (")
        assert {"full": "No space left", "read-only": "Read-only", "no folder": "Not a directory"}[kind] in line
        assert not [path for path in home.rglob("*") if path.is_file() and path.name != "ballast"]

"""Compiled loops are kept by content, and nothing that happens to the cache folder stops the work."""

import logging
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FunctionType

import llvmlite.binding
import pytest

from rig import jit as compiled
from rig.jit import function_digest, njit

ROOT = Path(__file__).parents[3]
SCALE = 2.0


def _sum(values):
    return values * SCALE


@njit()
def _inner(value):
    return value + 1.0


def _outer(value):
    return _inner(value)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path))
    compiled._warned().clear()
    return tmp_path / "kernels"


def copy_of(function: FunctionType, **globals_: object) -> FunctionType:
    """The function as another process would define it, with some of its globals replaced."""
    copy = FunctionType(function.__code__, function.__globals__ | globals_, function.__name__)
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    return copy


def test_a_function_compiled_once_is_found_by_the_next(folder: Path) -> None:
    first, second = njit()(copy_of(_sum)), njit()(copy_of(_sum))
    assert first(3.0) == 6.0
    (file,) = folder.iterdir()
    before = file.stat().st_mtime_ns
    assert second(3.0) == 6.0
    assert sum(second.stats.cache_hits.values()) == 1
    assert [path.stat().st_mtime_ns for path in folder.iterdir()] == [before]
    assert second(3) == 6.0
    assert len(list(folder.iterdir())) == 2, "one for each type of argument"


def test_what_a_wheel_carries_is_found_if_whole(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    njit()(copy_of(_sum))(3.0)
    carried = folder.rename(tmp_path / "carried")
    monkeypatch.setattr(compiled, "CARRIED", carried)
    found = njit()(copy_of(_sum))
    assert found(3.0) == 6.0
    assert found.stats.cache_hits
    assert not folder.exists()
    next(carried.iterdir()).write_bytes(b"?")
    made = njit()(copy_of(_sum))
    assert made(3.0) == 6.0
    assert not made.stats.cache_hits
    assert len(list(folder.iterdir())) == 1


def test_another_constant_another_option_or_another_callee_is_another_function() -> None:
    plain = function_digest(njit()(copy_of(_outer)))
    assert function_digest(njit()(copy_of(_outer))) == plain
    assert function_digest(njit(fastmath=True)(copy_of(_outer))) != plain
    assert function_digest(njit()(copy_of(_outer, _inner=njit()(copy_of(_sum))))) != plain
    assert function_digest(njit()(copy_of(_sum, SCALE=3.0))) != function_digest(njit()(copy_of(_sum)))


@pytest.mark.parametrize("damage", [b"", b"x" * 50], ids=["empty", "other bytes"])
def test_a_damaged_file_is_made_again(folder: Path, damage: bytes) -> None:
    njit()(copy_of(_sum))(3.0)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for content in (damage, whole[:-1], whole[:-1] + b"?"):
        file.write_bytes(content)
        again = njit()(copy_of(_sum))
        assert again(3.0) == 6.0
        assert not again.stats.cache_hits
        assert len(file.read_bytes()) > 1000


def test_a_folder_that_cannot_be_written_is_told_once_and_the_work_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path / "file"))
    compiled._warned().clear()
    with caplog.at_level(logging.WARNING):
        assert njit()(copy_of(_sum))(3.0) == 6.0
        assert njit()(copy_of(_sum))(3) == 6.0
    (line,) = caplog.messages
    assert line.startswith("compiled loops and arrays of head models are not kept in")


def output_of(code: str, env: Mapping[str, str]) -> str:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=env, cwd=ROOT, capture_output=True, text=True, check=True, timeout=300).stdout


def test_another_process_with_another_hash_seed_finds_it(folder: Path) -> None:
    code = (
        "from pipeline.geometry.projection_kernels import distorted; import numpy as np;"
        "distorted(0.1, 0.2, np.zeros(5)); print(len(distorted.stats.cache_hits))"
    )
    found = [output_of(code, os.environ | {"PYTHONHASHSEED": seed}) for seed in ("1", "2")]
    assert found == ["0\n", "1\n"]


@pytest.mark.parametrize("variables", [{}, {"NUMBA_CPU_NAME": "generic"}])
def test_what_one_machine_compiled_runs_on_the_next(variables: dict[str, str]) -> None:
    """For one level of x86-64 where the machine has it; NUMBA_CPU_NAME goes before."""
    features = llvmlite.binding.get_host_cpu_features()
    if not all(features.get(feature) for feature in compiled.PORTABLE_FEATURES):
        pytest.skip("another processor: it compiles for itself")
    code = "from rig.jit import machine; print(machine())"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_CPU")} | variables
    assert repr(variables.get("NUMBA_CPU_NAME", compiled.PORTABLE_CPU)) in output_of(code, environment)


def test_every_compiled_loop_of_the_project_is_kept() -> None:
    for room in ("rig", "pipeline", "calibration", "server"):
        for path in (ROOT / room).rglob("*.py"):
            if path != ROOT / "pipeline" / "compiled.py":
                assert "from numba import njit" not in path.read_text(encoding="utf-8"), f"{path}: rig.jit"

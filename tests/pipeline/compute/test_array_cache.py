"""Arrays that a model decides are made once, and nothing that happens to the cache folder stops the work."""

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.compute import array_cache
from pipeline.compute.array_cache import UNUSED_S
from rig import jit as compiled
from rig.mesh import vertex_normals
from server.processes import python_environment
from tests.support.at_once import run_at_once

GIVEN = (np.arange(12.0).reshape(4, 3), 2.5, {"radius_mm": 4.0})
MADE = {
    "modes": np.arange(24, dtype=np.float32).reshape(2, 4, 3),
    "seen": np.array([True, False]),
    "none": np.zeros((0, 3)),
    "scale": np.array(1.5),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path / "cache"))
    compiled._warned().clear()
    return tmp_path / "cache" / "arrays"


class Maker:
    """Counts how often it had to make them."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self, *inputs: object) -> dict[str, np.ndarray]:
        def make() -> dict[str, np.ndarray]:
            self.times += 1
            return MADE

        return array_cache.cached_arrays("modes", inputs or GIVEN, make, made_by=(vertex_normals,))


def equal(found: dict[str, np.ndarray]) -> bool:
    return list(found) == list(MADE) and all(
        found[name].dtype == array.dtype and found[name].shape == array.shape and (found[name] == array).all()
        for name, array in MADE.items()
    )


def test_they_are_made_once_and_mapped_read_only_and_aligned(folder: Path) -> None:
    maker = Maker()
    for _ in range(3):
        found = maker()
        assert equal(found)
        assert all(not array.flags.writeable and array.flags.c_contiguous for array in found.values())
        assert all(array.flags.aligned for array in found.values())
    assert maker.times == 1
    assert len(list(folder.iterdir())) == 1
    assert all(array.flags.writeable for array in MADE.values())


def test_another_input_thread_count_or_source_is_another_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maker = Maker()
    maker()
    for inputs in (
        (GIVEN[0] + 1, *GIVEN[1:]),
        (GIVEN[0].astype(np.float32), *GIVEN[1:]),
        (*GIVEN[:2], {"radius_mm": 5}),
    ):
        maker(*inputs)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    maker()
    monkeypatch.setattr(array_cache, "_source", lambda module: module.encode())
    maker()
    assert maker.times == len(list(folder.iterdir())) == 6


@pytest.mark.parametrize(
    "damage", [lambda data: b"", lambda data: data[:-1], lambda data: data[:70] + b"?" + data[71:]]
)
def test_a_damaged_file_is_made_again(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    maker = Maker()
    maker()
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    assert equal(maker())
    assert maker.times == 2
    assert equal(maker())
    assert maker.times == 2


def test_a_folder_that_cannot_be_written_is_said_in_one_line(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder.parent.write_text("a file where the folder should be")
    maker = Maker()
    with caplog.at_level(logging.WARNING):
        assert equal(maker())
        found = maker()
    assert equal(found)
    assert not any(array.flags.writeable for array in found.values())
    (line,) = caplog.messages
    assert line.startswith("compiled loops and arrays of head models are not kept in")


def test_a_full_disk_leaves_nothing_half(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(array_cache, "write_atomically", full)
    assert equal(Maker()())
    assert not folder.exists()


def test_two_at_once_do_no_harm(folder: Path) -> None:
    assert all(map(equal, run_at_once(Maker(), 8)))
    assert len(list(folder.iterdir())) == 1


def test_a_file_that_nobody_used_for_a_month_goes_and_one_in_use_stays(folder: Path) -> None:
    maker = Maker()
    maker()
    (file,) = folder.iterdir()
    old = time.time() - UNUSED_S - 60
    os.utime(file, (old, old))
    maker()  # a use
    maker(1)
    assert file.exists()
    os.utime(file, (old, old))
    maker(2)
    assert not file.exists()
    assert maker.times == 3


KEPT = """
from pipeline.head_model.model import load_model
from pipeline.photometric_fit.refine import finer
from pipeline.head_model.gaussian_process import model_basis
from pipeline.settings import Settings
model = model_basis(load_model(), Settings())
fine, patches, at_centres = finer(model)
print(hash((model.modes.tobytes(), fine.modes.tobytes(), fine.sigma.tobytes(), patches.member.tobytes(),
            patches.agreement.tobytes(), at_centres.tobytes())), at_centres.flags.writeable)
"""


@pytest.mark.slow
def test_what_another_process_kept_is_what_this_one_would_have_made(folder: Path) -> None:
    environment = python_environment() | {"PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", KEPT]
    runs = [subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)]
    assert sorted(path.name.rpartition("-")[0] for path in folder.iterdir()) == ["fine-modes", "kernel-modes"]
    assert runs[0].stdout.split()[:2] == runs[1].stdout.split()[:2]
    assert runs[0].stdout.split()[1] == "False"

"""Compiling ahead: everything once, and no harm where it is stopped, cannot be kept, or is done twice."""

import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pipeline import compiled, kernel_list
from pipeline.kernel_list import Kernel
from server.tasks.prepare import prepare_kernels

LINES = (
    "dense.surface.grid_kernels:grown bool[3C]",
    "texture.vertex_colours_kernels:blend_views float32[2C] float32[3C] float64",
)


class Stopped(Exception):
    pass


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and a list of two loops."""
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(kernel_list, "listed_kernels", lambda: [Kernel.from_line(line) for line in LINES])
    compiled._warned().clear()
    return tmp_path / "cache" / "kernels"


def kept(folder: Path) -> set[str]:
    return {path.name.partition("-")[0] for path in folder.iterdir()}


@pytest.mark.slow
def test_what_is_missing_is_compiled_once_and_counted_aloud(folder: Path) -> None:
    told: list[tuple[str, float]] = []
    assert prepare_kernels(lambda stage, share: told.append((stage, share))) == (2, 2)
    assert told == [(f"compiling {done} of 2 loops", done / 2) for done in range(3)]
    assert {"grid_kernels.grown", "vertex_colours_kernels.blend_views"} <= kept(folder)
    told.clear()
    assert prepare_kernels(lambda stage, share: told.append((stage, share))) == (0, 2)
    assert told == []
    next(folder.glob("grid_kernels.grown-*")).unlink()
    assert prepare_kernels(lambda stage, share: None) == (1, 2)


@pytest.mark.slow
def test_two_at_once_and_one_that_is_stopped_do_no_harm(folder: Path) -> None:
    def stop(stage: str, share: float) -> None:
        if share:
            raise Stopped

    with pytest.raises(Stopped):
        prepare_kernels(stop)
    for path in folder.iterdir():
        assert not path.name.startswith(".")
    with ThreadPoolExecutor(2) as pool:
        done = [pool.submit(prepare_kernels, lambda stage, share: None) for _ in range(2)]
        assert {future.result()[1] for future in done} == {2}
    assert prepare_kernels(lambda stage, share: None) == (0, 2)


def test_a_folder_that_cannot_be_written_is_said_in_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder.parent.write_text("a file where the folder should be")
    with caplog.at_level(logging.WARNING):
        assert prepare_kernels(lambda stage, share: pytest.fail("compiles in vain")) == (0, 2)
        assert prepare_kernels(lambda stage, share: pytest.fail("compiles in vain")) == (0, 2)
    (line,) = caplog.messages
    assert line.startswith("compiled kernels are not kept")

"""A capture as it lies on a disk: unpacked where it is packed, and the same head in a child as in the command."""

import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from rig.errors import InputError
from rig.formats.captures.archive import pack_folder
from rig.render.renderer import Renderer
from server.tasks.child import Child, WorkerContext
from server.tasks.reconstruct import folder_of, reconstruct_beside
from tests.support.services import ROOT, packed_capture, small_capture
from tests.support.small_studio import small_studio_captures

SETTINGS = {"detail": "span", "outputs": {"surface": "head"}}


def test_an_archive_is_a_folder_for_as_long_as_it_is_needed(tmp_path: Path) -> None:
    with folder_of(packed_capture(tmp_path)) as folder:
        assert (folder / "cameras.json").is_file()
    assert not folder.exists()
    capture = small_capture(tmp_path / "anna")
    with folder_of(capture) as folder:
        assert folder == capture
    assert capture.exists()
    (tmp_path / "no.zip").write_text("none")
    with pytest.raises(InputError), folder_of(tmp_path / "no.zip"):
        pass


def test_what_a_bench_keeps_is_made_once_and_closed_at_its_end(tmp_path: Path) -> None:
    with closing(WorkerContext()) as context:
        (tmp_path / "file").write_text("x")
        first = context.keep("file", (tmp_path / "file").open)
        assert context.keep("file", lambda: pytest.fail("made twice")) is first
        assert not first.closed
    assert first.closed


@pytest.mark.slow
@pytest.mark.gl
def test_a_child_makes_what_the_command_makes_to_the_byte(tmp_path: Path, renderer: Renderer) -> None:
    """From an archive, with one thread; all that is temporary goes into ``scratch`` and is gone."""
    capture = small_studio_captures(tmp_path / "shots", 1, renderer) / "s0"
    pack_folder(capture, tmp_path / "s0.tar")
    options = ["--out", str(tmp_path / "one"), "--detail", "span", "--surface", "head"]
    command = [sys.executable, "-m", "server.cli", "reconstruct", str(capture), *options]
    subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, timeout=240, check=True)
    for folder in ("result", "scratch"):
        (tmp_path / folder).mkdir()
    with closing(Child(variables={"EIGENHEAD_THREADS": "1"})) as child:
        run = child.remote(reconstruct_beside)
        run(
            parent=os.getpid(), capture=str(tmp_path / "s0.tar"), result=str(tmp_path / "result"),
            scratch=str(tmp_path / "scratch"), model=None, settings=SETTINGS,
        )  # fmt: skip
    assert list((tmp_path / "scratch").iterdir()) == []
    names = sorted(path.relative_to(tmp_path / "one").as_posix() for path in (tmp_path / "one").rglob("*.*"))
    assert "head.ply" in names
    differ = [
        name for name in names if (tmp_path / "result" / name).read_bytes() != (tmp_path / "one" / name).read_bytes()
    ]
    assert differ == ["report.json"]  # by its seconds

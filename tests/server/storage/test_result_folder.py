"""A result folder that is used again holds the new result and what is nobody's result, and nothing else."""

from pathlib import Path

import pytest

from server.storage.result_folder import fresh_folder


def filled(folder: Path, names: list[str]) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(str(folder))


def names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_stale_files_go_and_foreign_ones_stay(tmp_path: Path) -> None:
    out = tmp_path / "heads" / "anna"
    with fresh_folder(out) as fresh:
        filled(fresh, ["head.ply", "head.obj", "head_atlas.glb", "bust.ply", "report.json", "overlays/cam00.png"])
    filled(out, ["notes.txt", "simplex/head.ply"])
    with fresh_folder(out) as fresh:
        filled(fresh, ["head.ply", "report.json", "overlays/cam01.png"])
    assert names(out) == ["head.ply", "notes.txt", "overlays/cam01.png", "report.json", "simplex/head.ply"]
    assert [path.name for path in out.parent.iterdir()] == ["anna"]


def test_work_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    out = tmp_path / "anna"
    filled(out, ["head.ply"])

    def work() -> None:
        with fresh_folder(out) as fresh:
            filled(fresh, ["head.ply", "report.json"])
            raise RuntimeError

    with pytest.raises(RuntimeError):
        work()
    assert names(tmp_path) == ["anna/head.ply"]


def test_a_place_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place in (tmp_path / "file", tmp_path / "file" / "inside"):
        with pytest.raises(OSError, match=r"Not a directory|File exists"), fresh_folder(place):
            pytest.fail("entered")

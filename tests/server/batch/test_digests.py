"""A capture's digest is of its names and bytes, and of nothing else."""

import os
from pathlib import Path

import pytest

from server.batch.digests import capture_sha256


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    for name in ("images/cam00.png", "images/cam01.png", "cameras.json"):
        (tmp_path / "anna" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "anna" / name).write_text(name)
    return tmp_path / "anna"


def test_names_and_bytes_count_and_times_and_junk_do_not(capture: Path) -> None:
    before = capture_sha256(capture)
    os.utime(capture / "cameras.json", (0, 0))
    (capture / ".DS_Store").write_text("junk")
    (capture / "images" / "Thumbs.db").write_text("junk")
    assert capture_sha256(capture) == before
    (capture / "images" / "cam00.png").rename(capture / "images" / "cam02.png")
    renamed = capture_sha256(capture)
    (capture / "cameras.json").write_text("other")
    assert len({before, renamed, capture_sha256(capture)}) == 3


def test_where_bytes_are_cut_between_files_counts(tmp_path: Path) -> None:
    for name, first, second in (("a", "xy", "z"), ("b", "x", "yz")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1").write_text(first)
        (tmp_path / name / "2").write_text(second)
    assert capture_sha256(tmp_path / "a") != capture_sha256(tmp_path / "b")


def test_files_behind_links_count_and_a_circle_ends(capture: Path, tmp_path: Path) -> None:
    before = capture_sha256(capture)
    (capture / "images").rename(tmp_path / "elsewhere")
    (capture / "images").symlink_to(tmp_path / "elsewhere")
    assert capture_sha256(capture) == before
    (capture / "images" / "again").symlink_to(capture)
    assert capture_sha256(capture) == before


def test_an_archive_is_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(b"abc")
    assert capture_sha256(tmp_path / "a.zip") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    with pytest.raises(FileNotFoundError):
        capture_sha256(tmp_path / "gone")

"""Results complete or absent, and what a record says of them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from server.batch.captures import WHOLE, Shard
from server.batch.folder import BatchFolder, Origin, file_name

ORIGIN = Origin("11" * 32, "22" * 32, "33" * 32, "0.1.0")


@pytest.fixture
def folder(tmp_path: Path) -> BatchFolder:
    return BatchFolder(tmp_path / "heads")


def publish(folder: BatchFolder, name: str, content: bytes = b"mesh", origin: Origin = ORIGIN) -> None:
    attempt = folder.new_attempt(WHOLE)
    (attempt / "result" / "head.ply").write_bytes(content)
    (attempt / "result" / "overlays").mkdir()
    (attempt / "result" / "overlays" / "cam00.png").write_bytes(b"png")
    (attempt / "result" / "report.json").write_text('{"seconds": 1}')
    folder.publish(name, attempt, origin)


def test_a_published_result_says_what_it_follows_from(folder: BatchFolder) -> None:
    publish(folder, "monday/anna")
    assert folder.origin("monday/anna") == ORIGIN
    assert folder.report("monday/anna") == {"seconds": 1}
    assert folder.origin("monday") is None
    record = json.loads((folder.result("monday/anna") / "batch.json").read_text())
    assert record["files"] == {"head.ply": 4, "overlays/cam00.png": 3}


@pytest.mark.parametrize(
    "damage",
    [
        lambda result: (result / "head.ply").unlink(),
        lambda result: (result / "head.ply").write_bytes(b"me"),
        lambda result: (result / "report.json").unlink(),
        lambda result: (result / "batch.json").write_text("{"),
        lambda result: (result / "batch.json").write_text('{"format": "eigenhead-batch-result/2"}'),
        lambda result: (result / "overlays" / "cam00.png").unlink(),
    ],
)
def test_a_damaged_result_is_none(folder: BatchFolder, damage) -> None:
    publish(folder, "anna")
    damage(folder.result("anna"))
    assert folder.origin("anna") is None


def test_a_new_result_takes_the_place_of_the_old_one_as_a_whole(folder: BatchFolder) -> None:
    publish(folder, "anna")
    (folder.result("anna") / "head.obj").write_bytes(b"asked for once")
    other = replace(ORIGIN, input_sha256="44" * 32)
    publish(folder, "anna", b"another", other)
    assert folder.origin("anna") == other
    assert not (folder.result("anna") / "head.obj").exists()


def test_the_version_is_no_reason_to_make_a_head_again() -> None:
    assert ORIGIN.is_of(replace(ORIGIN, version="0.2.0"))
    for other in ("input_sha256", "settings_sha256", "model_sha256"):
        assert not ORIGIN.is_of(replace(ORIGIN, **{other: "44" * 32}))


def test_attempts_of_ended_shares_and_empty_folders_go(folder: BatchFolder) -> None:
    first, second = Shard(1, 2), Shard(2, 2)
    with folder.share(second):
        with folder.share(first):
            alive = folder.new_attempt(second)
            assert folder.new_attempt(first) != folder.new_attempt(first)
        assert list(folder.attempts.iterdir()) == [alive]
        dead = folder.new_attempt(first)  # as a kill leaves it: the lock went with the process
        (folder.work / "1-of-2.lock").touch()
    assert not dead.exists()
    assert not folder.work.exists()


def test_file_names_are_short_readable_and_apart() -> None:
    names = ["monday/anna", "monday-anna", "monday.anna", "x" * 300, "x" * 301, "Ä/Ö", "\udcff"]
    files = [file_name(name) for name in names]
    assert len(set(files)) == len(names)
    assert all(len(file.encode("utf-8", "surrogateescape")) < 140 and "/" not in file for file in files)
    assert files[0].startswith("monday-anna.")

"""Faces are found once, and anew only where what they follow from has changed."""

from pathlib import Path
from typing import Any

from server.storage import face_cache
from server.storage.face_cache import faces_once

INPUTS = {"images/cam00.png": "a1", "cameras.json": "b2"}
FOUND: dict[str, Any] = {"faces": {"cam00": []}, "suggested": {"pronasale": {"cam00": [1.5, 2.0]}}}


def looked(folder: Path, inputs: dict[str, str]) -> bool:
    """Whether the faces had to be looked for."""
    calls: list[int] = []

    def find() -> dict[str, Any]:
        calls.append(1)
        return FOUND

    assert faces_once(folder, inputs, find) == FOUND
    return bool(calls)


def test_they_come_back_and_picked_points_change_nothing(tmp_path: Path) -> None:
    assert looked(tmp_path / "faces", INPUTS)
    assert not looked(tmp_path / "faces", INPUTS)
    assert not looked(tmp_path / "faces", INPUTS | {"features.json": "c3"})
    assert looked(tmp_path / "faces", INPUTS | {"images/cam00.png": "a9"})


def test_other_code_looks_again(tmp_path: Path, monkeypatch) -> None:
    assert looked(tmp_path, INPUTS)
    monkeypatch.setattr(face_cache, "code_digest", lambda rooms: "of another version")
    assert looked(tmp_path, INPUTS)


def test_a_damaged_file_is_made_anew(tmp_path: Path) -> None:
    assert looked(tmp_path, INPUTS)
    (path,) = tmp_path.glob("*.faces.json")
    for damaged in ("{", "[]", '{"faces": {}}'):
        path.write_text(damaged)
        assert looked(tmp_path, INPUTS)
        assert not looked(tmp_path, INPUTS)


def test_a_capture_that_is_erased_meanwhile_stays_erased(tmp_path: Path) -> None:
    folder = tmp_path / "cache" / "faces"

    def find() -> dict[str, Any]:
        folder.rmdir()
        folder.parent.rmdir()
        return FOUND

    assert faces_once(folder, INPUTS, find) == FOUND
    assert not folder.parent.exists()

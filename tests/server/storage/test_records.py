"""Records as they lie in the data folder: read once, and damaged where a field is missing."""

import json
import os
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rig.files import write_atomically
from server.errors import NotFound
from server.storage.records import (
    CALIBRATION,
    CAPTURE,
    UPLOAD,
    CalibrationRecord,
    CaptureRecord,
    SessionRecord,
    UploadRecord,
)
from server.storage.store import Store, new_id
from tests.support.stored_captures import capture_record, stored


def test_a_capture_comes_back_as_it_was_stored(tmp_path: Path) -> None:
    store, record = Store(tmp_path), capture_record()
    stored(store, record)
    assert store.capture(record.id) == record
    changed = store.change_capture(record.id, lambda old: replace(old, label="bert"))
    assert [*store.captures()] == [changed] == [replace(record, label="bert")]


def test_a_record_of_an_older_version_says_nothing_of_boards(tmp_path: Path) -> None:
    store, record = Store(tmp_path), capture_record()
    path = stored(store, record)
    document = json.loads(path.read_text())
    del document["board"]
    path.write_text(json.dumps(document | {"unheard-of": 1}))
    assert store.capture(record.id) == record


@pytest.mark.parametrize("damage", [{"cameras": 3}, {"id": "another"}, {"format": "eigenhead-capture/9"}])
def test_a_damaged_record_is_set_aside(tmp_path: Path, damage: dict[str, object]) -> None:
    store, record = Store(tmp_path), capture_record()
    path = stored(store, record)
    path.write_text(json.dumps(json.loads(path.read_text()) | damage))
    with pytest.raises(NotFound):
        store.capture(record.id)
    assert len(store.list_quarantined()) == 1


def test_formats_are_not_mistaken_for_each_other() -> None:
    upload = UploadRecord(new_id(), 3, {"label": "anna"}, "local", 1.5, None)
    assert UPLOAD.read(json.loads(json.dumps(UPLOAD.document(upload)))) == upload
    for other in (UPLOAD.document(upload), [], None, {}):
        with pytest.raises(ValueError, match="no eigenhead-capture"):
            CAPTURE.read(other)


def in_parallel(*calls: Callable[[], object]) -> None:
    """Each in a thread of its own, all let go at once; what is not there is passed over."""
    gate = threading.Barrier(len(calls))

    def run(call: Callable[[], object]) -> None:
        gate.wait()
        with suppress(NotFound):
            call()

    with ThreadPoolExecutor(len(calls)) as pool:
        for done in [pool.submit(run, call) for call in calls]:
            done.result()


def test_changes_at_once_lose_nothing_and_what_was_removed_stays_gone(tmp_path: Path, slow_writes: None) -> None:
    store, record = Store(tmp_path), SessionRecord(new_id(), "2026-01-01T00:00:00.000Z", "anna", "")
    store.add_session(record)
    in_parallel(
        lambda: store.change_session(record.id, lambda old: replace(old, label="berta")),
        lambda: store.change_session(record.id, lambda old: replace(old, consent="signed")),
    )
    assert store.session(record.id) == replace(record, label="berta", consent="signed")
    taken = capture_record()
    stored(store, taken)
    changes = [
        *(partial(store.change_session, record.id, lambda old: replace(old, label="clara")) for _ in range(4)),
        *(partial(store.change_capture, taken.id, lambda old: replace(old, label="clara")) for _ in range(4)),
    ]
    in_parallel(*changes, partial(store.remove_session, record.id), partial(store.remove_capture, taken.id))
    assert [*(tmp_path / "sessions").iterdir()] == [*(tmp_path / "captures").iterdir()] == []


def test_a_folder_that_somebody_else_removed_is_not_made_again(tmp_path: Path) -> None:
    store, record = Store(tmp_path), capture_record()
    folder = stored(store, record).parent

    def change(old: CaptureRecord) -> CaptureRecord:
        shutil.rmtree(folder)
        return old

    with pytest.raises(NotFound):
        store.change_capture(record.id, change)
    assert not folder.exists()


def test_what_a_kill_left_of_a_record_goes_with_it_and_with_time(tmp_path: Path) -> None:
    store, record = Store(tmp_path), SessionRecord(new_id(), "2026-01-01T00:00:00.000Z", "anna", "signed")
    store.add_session(record)
    folders = [tmp_path / "sessions", tmp_path / "rig", stored(store, capture_record()).parent]
    of_record, *others = [
        folder / f".{name}.abcd.part" for folder in folders for name in (f"{record.id}.json", "other")
    ]
    for part in (of_record, *others):
        part.write_text("anna")
        os.utime(part, (0, 0))
    others[0].touch()  # is being written
    store.remove_session(record.id)
    assert [part.exists() for part in (of_record, *others)] == [False] + 5 * [True]
    assert store.sweep(older_s=900) == 4
    assert [part.exists() for part in others] == [True] + 4 * [False]


@pytest.fixture
def slow_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a disk that is slow to sync: long enough for every race."""

    def slowly(*arguments: Any, **named: Any) -> None:
        time.sleep(0.02)
        write_atomically(*arguments, **named)

    monkeypatch.setattr("server.storage.store.write_atomically", slowly)


@pytest.mark.parametrize(
    "damage", ["", "[]", '{"cam00": 3}', '{"cam00": {"mean": "dark"}}', '{"cam00": {"subject": {}}}', "[" * 100_000]
)
def test_damaged_checks_say_nothing(tmp_path: Path, damage: str) -> None:
    store, record = Store(tmp_path), capture_record()
    path = stored(store, record).with_name("checks.json")
    path.write_text('{"cam00": {"mean": 90.5, "blur_px": null}}')
    assert store.checks(record.id) == {"cam00": {"mean": 90.5, "blur_px": None}}
    path.write_text(damage)
    assert store.checks(record.id) == {}


def test_a_session_without_its_label_is_set_aside(tmp_path: Path) -> None:
    store, record = Store(tmp_path), SessionRecord(new_id(), "2026-01-01T00:00:00.000Z", "anna", "")
    store.add_session(record)
    assert store.session(record.id) == record
    path = store.folder("sessions", record.id).with_suffix(".json")
    path.write_text(path.read_text().replace('"label"', '"table"'))
    with pytest.raises(NotFound):
        store.session(record.id)
    assert len(store.list_quarantined()) == 1


@pytest.mark.parametrize("damage", ["", "{}", "[]"])
def test_a_damaged_calibration_is_set_aside(tmp_path: Path, damage: str) -> None:
    store, identity = Store(tmp_path), new_id()
    path = store.folder("calibrations", identity) / "record.json"
    path.parent.mkdir()
    record = CalibrationRecord(identity, "2026-01-01T00:00:00.000Z", "rig", "", {"cam00": 3})
    path.write_text(json.dumps(CALIBRATION.document(record)))
    assert store.calibration(identity) == record
    path.write_text(damage)
    with pytest.raises(NotFound):
        store.calibration(identity)
    assert len(store.list_quarantined()) == 1

"""Records as they lie in the data folder: read once, and damaged where a field is missing."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from server.errors import NotFound
from server.storage.records import CAPTURE, UPLOAD, CameraSize, CaptureRecord, SessionRecord, UploadRecord
from server.storage.store import Store, new_id


def capture_record() -> CaptureRecord:
    return CaptureRecord(
        id=new_id(),
        created="2026-01-01T00:00:00.000Z",
        source="upload",
        session=None,
        label="anna",
        expression="",
        cameras=(CameraSize("cam00", 64, 48),),
        front="cam00",
        inputs={"images/cam00.png": "0" * 64},
        bytes=10,
        features=False,
        shot={"sync": {"cameras": {}}},
    )


def stored(store: Store, record: CaptureRecord) -> Path:
    with store.incoming() as folder:
        (folder / "capture" / "files").mkdir(parents=True)
        store.add_capture(folder / "capture", record)
    return store.folder("captures", record.id) / "record.json"


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
    assert len(store.set_aside()) == 1


def test_a_session_without_its_label_is_set_aside(tmp_path: Path) -> None:
    store, record = Store(tmp_path), SessionRecord(new_id(), "2026-01-01T00:00:00.000Z", "anna", "")
    store.save_session(record)
    assert store.session(record.id) == record
    path = store.folder("sessions", record.id).with_suffix(".json")
    document = json.loads(path.read_text())
    del document["label"]
    path.write_text(json.dumps(document))
    assert [*store.sessions()] == []
    assert len(store.set_aside()) == 1


def test_formats_are_not_mistaken_for_each_other() -> None:
    upload = UploadRecord(new_id(), 3, {"label": "anna"}, "local", 1.5, None)
    assert UPLOAD.read(json.loads(json.dumps(UPLOAD.document(upload)))) == upload
    for other in (UPLOAD.document(upload), [], None, {}):
        with pytest.raises(ValueError, match="no eigenhead-capture"):
            CAPTURE.read(other)

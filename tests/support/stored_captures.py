"""Captures in a store without the service that took them in."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from rig.files import sha256_of
from server.storage.records import CameraSize, CaptureRecord
from server.storage.store import Store, new_id


def capture_record(**changed: Any) -> CaptureRecord:
    """The record of an upload from one camera, or what is ``changed`` of it."""
    record = CaptureRecord(
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
    return replace(record, **changed)


def stored(store: Store, record: CaptureRecord, files: Path | None = None) -> Path:
    """Where the record of a capture lies that was stored with a copy of ``files``, or with none."""
    with store.incoming() as folder:
        (folder / "capture" / "files").mkdir(parents=True)
        if files is not None:
            shutil.copytree(files, folder / "capture" / "files", dirs_exist_ok=True)
        store.add_capture(folder / "capture", record)
    return store.folder("captures", record.id) / "record.json"


def stored_files(store: Store, files: Path, **changed: Any) -> str:
    """The id of a capture that was stored with a copy of ``files``, which its record names."""
    paths = [path for path in files.rglob("*") if path.is_file()]
    inputs = {path.relative_to(files).as_posix(): sha256_of(path) for path in paths}
    record = capture_record(inputs=inputs, **changed)
    stored(store, record, files)
    return record.id

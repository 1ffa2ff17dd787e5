"""Stores captures, sessions and results on disk.

    <data>/captures/<id>/record.json  files/...          one folder a capture, as docs/capture-format.md has it;
                                                         checks.json has what was measured of each camera's picture
    <data>/sessions/<id>.json
    <data>/jobs/<id>/result/...  log.txt                 and attempt-*/ while a worker writes
    <data>/cache/captures/<id>/...                       what is worth keeping of a capture, and can be made anew
    <data>/calibrations/<id>/...  rig/...                 see server.services.calibrations, server.services.rigs
    <data>/incoming/<id>/                                what is being received; swept after a crash
    <data>/trash/                                        what is being deleted
    <data>/set-aside/                                    damaged records, moved here and reported
    <data>/last-sweep.json  retention-stopped.txt         what retention knows of the clock
    <data>/has-keys                                      see server.services.keys

A folder appears under its final name in one rename, after everything in it reached the disk. Files in the data folder
that the service did not write itself are never read and never deleted.
"""

import hashlib
import json
import os
import re
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import structlog

from rig.acquisition.verdict import ViewDocument
from rig.files import sha256_of, unfinished, write_atomically
from rig.messages.message import compose
from server.errors import DiskFull, NotFound
from server.storage.capture_blobs import CaptureBlobs
from server.storage.folders import move_durably, newest, sync_folder
from server.storage.library import Library
from server.storage.records import (
    CALIBRATION,
    CAPTURE,
    SESSION,
    CalibrationRecord,
    CaptureRecord,
    RecordFormat,
    SessionRecord,
    read_checks,
)

ID = re.compile(r"^[0-9a-f]{28}$")
FOLDERS = ("captures", "sessions", "jobs", "incoming", "uploads", "trash", "set-aside", "calibrations", "cache", "rig")

log = structlog.get_logger()
T = TypeVar("T")


def new_id() -> str:
    """Returns a new id: 28 hex digits, 12 of the time in milliseconds and 16 random ones, so that ids sort by time."""
    return f"{time.time_ns() // 1_000_000:012x}{secrets.token_hex(8)}"


def repeatable_id(key: str, idempotency_key: str) -> str:
    """Returns the id of the thing that an API key requests under an Idempotency-Key: the same id each time."""
    return hashlib.sha256(f"{key}\0{idempotency_key}".encode()).hexdigest()[:28]


def is_id(text: str) -> bool:
    """Returns whether a text is an id: 28 hex digits."""
    return ID.match(text) is not None


@dataclass(frozen=True, slots=True)
class StoredFile:
    """Holds the path of a file and the SHA-256 of its content."""

    path: Path
    sha256: str

    def is_intact(self) -> bool:
        """Returns whether the file's content matches. The file is read anew when its time, size or inode changed."""
        said = self.path.stat()
        return _digest(self.path, said.st_mtime_ns, said.st_size, said.st_ino) == self.sha256


@lru_cache(maxsize=1 << 16)
def _digest(path: Path, *_: int) -> str:
    return sha256_of(path)


_THINGS = {
    "captures": compose("thing-capture"),
    "jobs": compose("thing-job"),
    "calibrations": compose("thing-calibration"),
    "sessions": compose("thing-session"),
    "uploads": compose("thing-upload"),
}


class DataFolder:
    """Knows where files lie in the data folder, and which of them are to be deleted. Methods block. Every id that comes
    from a request passes ``is_id`` before it becomes part of a path."""

    def __init__(self, data: Path) -> None:
        self.data = data
        for name in FOLDERS:
            (data / name).mkdir(parents=True, exist_ok=True)
        data.chmod(0o700)  # faces are biometric data

    def folder(self, kind: str, identity: str) -> Path:
        """Returns the folder of one stored object of a kind ("captures", "jobs" and so on), whether it exists or not.
        Raises NotFound for a text that is no id."""
        if not is_id(identity):
            raise NotFound(_THINGS.get(kind) or compose("thing-file"), identity)
        return self.data / kind / identity

    def ids(self, kind: str) -> list[str]:
        """Lists the ids of all stored objects of a kind ("captures", "jobs" and so on), newest first."""
        with suppress(FileNotFoundError):
            names = (entry.name.removesuffix(".json") for entry in os.scandir(self.data / kind))
            return sorted((name for name in names if is_id(name)), reverse=True)
        return []

    @contextmanager
    def incoming(self) -> Iterator[Path]:
        """Yields a new folder for files that are being received. Files that were not moved out of the folder are
        removed at the end of the block; after a kill ``sweep`` removes them."""
        folder = self.data / "incoming" / new_id()
        folder.mkdir(parents=True)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def free_bytes(self) -> int:
        """Returns the free bytes on the disk of the data folder."""
        return shutil.disk_usage(self.data).free

    def reserve(self, wanted: int, spare: int) -> None:
        """Raises DiskFull if ``wanted`` bytes would leave less than ``spare`` free."""
        if self.free_bytes() - wanted < spare:
            raise DiskFull

    def cache_of(self, identity: str) -> Path:
        """Returns the folder in which a capture's silhouettes, thumbnails and similar files are cached."""
        return self.folder("cache/captures", identity)

    def remove(self, path: Path) -> None:
        """Deletes a file or folder. ``path`` is first renamed into ``trash``, so it disappears even if the deletion is
        interrupted. Does nothing if ``path`` does not exist."""
        target = self.data / "trash" / f"{new_id()}"
        try:
            path.rename(target)
        except FileNotFoundError:
            return
        except OSError:  # a full file system may have no room for the new name
            target = path
        shutil.rmtree(target, ignore_errors=True) if target.is_dir() else target.unlink(missing_ok=True)

    def sweep(self, older_s: float) -> int:
        """Deletes files that crashes left in ``incoming`` and ``trash``, and half-written files, if untouched for
        ``older_s`` seconds. Returns how many were deleted."""
        removed = 0
        left = [self.data / kind / identity for kind in ("incoming", "trash") for identity in self.ids(kind)]
        for path in [*left, *self._unfinished()]:
            with suppress(FileNotFoundError):  # its write has ended
                if time.time() - newest(path) > older_s:
                    shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink()
                    removed += 1
        return removed

    def _unfinished(self) -> Iterator[Path]:
        """Yields unfinished files at the top of each kind's folder and of each stored object's folder."""
        for kind in FOLDERS:
            yield from unfinished(self.data / kind)
            for entry in os.scandir(self.data / kind):
                if entry.is_dir(follow_symlinks=False):
                    yield from unfinished(Path(entry))

    def list_quarantined(self) -> list[str]:
        """Lists the names of damaged records that were moved to the folder ``set-aside``."""
        return sorted(entry.name for entry in (self.data / "set-aside").iterdir())


class Store(DataFolder):
    """Reads and changes the records and files of captures and sessions in the data folder."""

    def __init__(
        self, data: Path, index: Library | None = None, blobs: CaptureBlobs | None = None, spare: int = 0
    ) -> None:
        """``blobs``: second place for files of captures; ``spare``: bytes to keep free when fetching them."""
        super().__init__(data)
        self._index, self.blobs, self._spare = index, blobs, spare
        self._changing = threading.Lock()  # two changes of one record must not lose one of them

    def add_capture(self, folder: Path, record: CaptureRecord) -> None:
        """Writes a capture's record into ``folder``, which holds ``files/``, and moves the folder to its final place in
        one rename. After a kill the capture is complete or absent. The store of captures also gets its files."""
        write_atomically(folder / "record.json", _encoded(CAPTURE.document(record)))
        move_durably(folder, self.folder("captures", record.id))
        self._tell(record)
        self.share(record)

    def share(self, record: CaptureRecord) -> bool:
        """Stores the files of a capture if a store is configured, as in ``CaptureBlobs.offer``."""
        if self.blobs is None:
            return True
        done = self.blobs.offer(record.id, self.folder("captures", record.id) / "files", record.inputs)
        if self.found("captures", record.id) is None:  # removed meanwhile
            self.blobs.release(record.id, later=True)
        return done

    def capture_files(self, identity: str) -> Path:
        """Returns the folder of a capture's files, after fetching missing ones from the store of captures. Raises
        NotFound, Unavailable, DiskFull, and Conflict for files that exist nowhere."""
        folder = self.folder("captures", identity) / "files"
        if self.blobs is not None:
            record = self.found("captures", identity)
            inputs = record.inputs if isinstance(record, CaptureRecord) else None
            self.blobs.restore(identity, folder, inputs, lambda size: self.reserve(size, self._spare))
            with suppress(FileNotFoundError):
                os.utime(folder)  # it is used
        return folder

    def found(self, kind: str, identity: str) -> CaptureRecord | SessionRecord | None:
        """Returns the record of a capture or session (``kind``: "captures", "sessions"). Returns None if the record is
        missing or damaged."""
        with suppress(NotFound):
            return self.capture(identity) if kind == "captures" else self.session(identity)
        return None

    def changes(self, kind: str) -> dict[str, int]:
        """Returns when the record of each capture or session was last written (ns), by id."""
        found = {}
        for identity in self.ids(kind):
            with suppress(FileNotFoundError, NotADirectoryError):
                found[identity] = self._record_path(kind, identity).stat().st_mtime_ns
        return found

    def _record_path(self, kind: str, identity: str) -> Path:
        folder = self.folder(kind, identity)
        return folder.with_suffix(".json") if kind == "sessions" else folder / "record.json"

    def _tell(self, record: CaptureRecord | SessionRecord) -> None:
        if self._index is not None:
            kind = "captures" if isinstance(record, CaptureRecord) else "sessions"
            self._index.put(record, self._record_path(kind, record.id).stat().st_mtime_ns)

    def capture(self, identity: str) -> CaptureRecord:
        """Returns the record of a capture. Raises NotFound."""
        return self._read("captures", identity, CAPTURE)

    def calibration(self, identity: str) -> CalibrationRecord:
        """Returns the record of a calibration. Raises NotFound."""
        return self._read("calibrations", identity, CALIBRATION)

    def put_checks(self, folder: Path, checks: Mapping[str, ViewDocument]) -> None:
        """Writes the measurements of a capture's pictures into the capture's folder before it is moved to its final
        place."""
        write_atomically(folder / "checks.json", _encoded(checks))

    def checks(self, identity: str) -> dict[str, ViewDocument]:
        """Returns the measurements of a capture's pictures by camera; none for a capture of an earlier version or if
        the file is damaged. Raises NotFound."""
        with suppress(FileNotFoundError, ValueError, RecursionError):
            return read_checks(json.loads((self.folder("captures", identity) / "checks.json").read_bytes()))
        self.capture(identity)
        return {}

    def captures(self) -> Iterator[CaptureRecord]:
        """Yields the records of all captures, newest first. Damaged records are set aside and left out."""
        for identity in self.ids("captures"):
            with suppress(NotFound):
                yield self.capture(identity)

    def change_capture(self, identity: str, change: Callable[[CaptureRecord], CaptureRecord]) -> CaptureRecord:
        """Replaces the record of a capture by what ``change`` returns for it, and returns the new record. Changes of a
        record wait for each other, and its file is replaced atomically. Raises NotFound."""
        with self._change("captures", identity):
            before = self.capture(identity)
            record = change(before)
            data = _encoded(CAPTURE.document(record))
            write_atomically(self._record_path("captures", identity), data, parents=False)
            self._tell(record)
        if record.inputs != before.inputs:
            self.share(record)
        return record

    @contextmanager
    def _change(self, kind: str, identity: str) -> Iterator[None]:
        """Allows one change or removal at a time, so that no change is lost and no removed object comes back. Raises
        NotFound, also for an object that another process removed meanwhile."""
        with self._changing:
            try:
                yield
            except FileNotFoundError as error:
                raise NotFound(_THINGS[kind], identity) from error

    def remove_capture(self, identity: str, *, later: bool = False) -> None:
        """Removes a capture and everything cached of it, which shows the face as well; its files in the store of
        captures go first. Raises Unavailable if the store does not answer; a second call completes the removal.
        ``later``: the next sweep removes the files in the store."""
        if self.blobs is not None:
            self.blobs.release(identity, later=later)
        with self._change("captures", identity):
            self.remove(self.folder("captures", identity))
            self.remove(self.cache_of(identity))
            for path in (self.data / "set-aside").glob(f"captures-{identity}-*"):
                self.remove(path)
            for upload in self.ids("uploads"):  # its record names label and session for two days
                if identity in self._upload_text(upload):
                    self.remove(self.folder("uploads", upload))
            if self._index is not None:
                self._index.drop("captures", identity)
        if self.blobs is not None:  # it may have been stored again since
            self.blobs.release(identity, later=later)

    def _upload_text(self, identity: str) -> str:
        with suppress(FileNotFoundError, NotADirectoryError):
            return (self.folder("uploads", identity) / "upload.json").read_text(encoding="utf-8")
        return ""

    def add_session(self, record: SessionRecord) -> None:
        """Writes the record of a session, replacing an earlier one atomically."""
        path = self._record_path("sessions", record.id)
        write_atomically(path, _encoded(SESSION.document(record)))
        sync_folder(path.parent)
        self._tell(record)

    def change_session(self, identity: str, change: Callable[[SessionRecord], SessionRecord]) -> SessionRecord:
        """Replaces the record of a session by what ``change`` returns for it, and returns the new record. Changes of a
        record wait for each other, and its file is replaced atomically. Raises NotFound."""
        with self._change("sessions", identity):
            record = change(self.session(identity))
            self.add_session(record)
        return record

    def remove_session(self, identity: str) -> None:
        """Removes the record of a session, and copies of it that a kill left half written. The session's captures
        stay."""
        with self._change("sessions", identity):
            path = self._record_path("sessions", identity)
            for part in [*unfinished(path.parent, path.name)]:
                self.remove(part)
            self.remove(path)
            if self._index is not None:
                self._index.drop("sessions", identity)

    def session(self, identity: str) -> SessionRecord:
        """Returns the record of a session. Raises NotFound."""
        return self._read("sessions", identity, SESSION)

    def _read(self, kind: str, identity: str, wanted: RecordFormat[T]) -> T:
        """Reads a record. Raises NotFound for a missing record, and for a damaged one, which is set aside."""
        path = self._record_path(kind, identity)
        whole = path if kind == "sessions" else path.parent
        try:
            data = path.read_bytes()
        except (FileNotFoundError, NotADirectoryError) as error:
            raise NotFound(_THINGS[kind], identity) from error
        with suppress(ValueError, RecursionError):
            document = json.loads(data)
            record = wanted.read(document)
            if document.get("id") == whole.stem:
                return record
        name = f"{whole.parent.name}-{whole.name}-{int(time.time())}"
        log.error("damaged record set aside", record=str(path), to=name)
        with suppress(OSError):
            whole.rename(self.data / "set-aside" / name)
        raise NotFound(_THINGS[kind], identity)


def _encoded(document: Mapping[str, object]) -> bytes:
    return json.dumps(document, indent=1, ensure_ascii=False).encode()

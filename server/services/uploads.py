"""Manages resumable uploads (tus 1.0) on disk: ``uploads/<id>/upload.json`` and ``uploads/<id>/data``."""

import fcntl
import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from pathlib import Path

from rig.files import write_atomically
from rig.messages.message import compose
from server.errors import Conflict, NotFound, TooLarge, TooMany
from server.settings import ServiceSettings
from server.storage.records import UPLOAD, UploadRecord
from server.storage.store import Store, is_id, new_id


def too_large(settings: ServiceSettings) -> TooLarge:
    """Returns the error that refuses an upload larger than the settings allow."""
    return TooLarge("upload-too-large", compose("upload-too-large", bytes=settings.body_bytes))


class ResumableUploads:
    """Manages resumable uploads. The offset of an upload is the length of its file ``data``, so a client can continue
    after the service was killed."""

    def __init__(self, store: Store, settings: ServiceSettings) -> None:
        self._store, self._settings = store, settings

    def create(self, length: int, fields: dict[str, str], key: str) -> UploadRecord:
        """Makes an upload of ``length`` bytes and returns its record. ``fields`` describe the future capture, ``key``
        is the id of the caller's API key. Raises TooLarge, TooMany if the key has too many unfinished uploads, and
        DiskFull if the disk has no space for it and the other unfinished uploads."""
        if length > self._settings.body_bytes:
            raise too_large(self._settings)
        unfinished = [*self._unfinished()]
        if (count := sum(record.key == key for record in unfinished)) >= self._settings.uploads_per_key:
            raise TooMany("too-many-uploads", compose("too-many-uploads", count=count), retry_after_s=60)
        promised = sum(record.length - self.offset(record) for record in unfinished)
        self._store.reserve(2 * length + promised, self._settings.free_bytes)
        identity = new_id()
        folder = self._store.folder("uploads", identity)
        folder.mkdir(parents=True)
        (folder / "data").touch()
        expires = time.time() + self._settings.upload_hours * 3600
        record = UploadRecord(identity, length, fields, key, expires, capture=None)
        self.save(record)
        return record

    def get(self, identity: str) -> UploadRecord:
        """Returns the record of an upload. Raises NotFound for an unknown or expired upload."""
        if not is_id(identity):
            raise NotFound(compose("thing-upload"), identity)
        with suppress(OSError, ValueError):
            path = self._store.folder("uploads", identity) / "upload.json"
            record = _read(path, path.stat().st_mtime_ns)
            if record.expires > time.time():
                return record
        raise NotFound(compose("thing-upload"), identity)

    def offset(self, record: UploadRecord) -> int:
        """Returns how many bytes of an upload were received. After the upload became a capture, this is the upload's
        full length, although the data was deleted."""
        if record.capture is not None:
            return record.length
        return self.data(record).stat().st_size

    def data(self, record: UploadRecord) -> Path:
        """Returns the path of the file that holds the bytes received so far."""
        return self._store.folder("uploads", record.id) / "data"

    def save(self, record: UploadRecord) -> None:
        """Replaces the record of an upload atomically. Raises NotFound if the upload was removed meanwhile."""
        path = self._store.folder("uploads", record.id) / "upload.json"
        try:
            write_atomically(path, json.dumps(UPLOAD.document(record)).encode(), parents=False)
        except FileNotFoundError as error:  # given up meanwhile
            raise NotFound(compose("thing-upload"), record.id) from error

    @contextmanager
    def lock(self, identity: str) -> Iterator[None]:
        """Locks an upload while the block runs, so that no other process writes or removes it. The lock ends with the
        process. Raises Conflict if the upload is locked already, and NotFound."""
        with ExitStack() as stack:
            try:
                stream = stack.enter_context((self._store.folder("uploads", identity) / "upload.json").open("rb"))
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (FileNotFoundError, NotADirectoryError) as error:  # removed since it was looked at
                raise NotFound(compose("thing-upload"), identity) from error
            except BlockingIOError as error:
                detail = compose("upload-busy")
                raise Conflict("upload-busy", detail) from error
            yield

    def remove(self, identity: str) -> None:
        """Removes an upload with its data. Does nothing if the upload is gone."""
        self._store.remove(self._store.folder("uploads", identity))

    def sweep(self) -> int:
        """Removes expired uploads to which no process is writing. Returns how many."""
        removed = 0
        for identity in self._store.ids("uploads"):
            try:
                self.get(identity)
            except NotFound:
                with suppress(Conflict, NotFound), self.lock(identity):
                    self.remove(identity)
                    removed += 1
        return removed

    def _unfinished(self) -> Iterator[UploadRecord]:
        for identity in self._store.ids("uploads"):
            with suppress(NotFound):
                record = self.get(identity)
                if record.capture is None and self.data(record).exists():
                    yield record


@lru_cache(maxsize=1 << 14)
def _read(path: Path, _: int) -> UploadRecord:
    """Reads an upload's record once for each time (ns) at which the record was written."""
    return UPLOAD.read(json.loads(path.read_bytes()))

"""Manages results of jobs in an object store, and the copies in the data folder.

If a store is configured, a job succeeds only after its result is in the store, and the data folder is a cache: the
least recently used large files are removed, and fetched again on request. Small files (reports, pictures of tables and
sheets) stay. Without a store the data folder holds all files.
"""

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import structlog

from rig.errors import Cancelled, EigenheadError
from rig.files import sha256_of
from rig.messages.message import compose
from server.errors import Conflict, Refused
from server.settings import ServiceSettings
from server.storage.object_places import open_objects
from server.storage.objects import ObjectMissing, StoreDenied, StoreUnavailable
from server.storage.records import FileEntry
from server.storage.store import Store, StoredFile
from server.storage.watched_objects import WatchedObjects

LARGE_BYTES = 1 << 20
LINK_S = 300
UNUSED_S = 900.0  # a file that is being sent is not that old
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0

log = structlog.get_logger()


class Results:
    """Keeps the results of jobs. ``objects``: the store of results; None: only the data folder. Methods block."""

    def __init__(self, store: Store, settings: ServiceSettings) -> None:
        place = settings.results_store
        self._store, self._spare = store, settings.free_bytes
        self.objects = None if place is None else WatchedObjects(open_objects(place, settings))
        self.collected = float("-inf")  # when this process last looked for unclaimed objects (s, monotonic)
        self.damaged = set[str]()

    def keep(
        self,
        job_id: str,
        files: Mapping[str, FileEntry],
        wanted: Callable[[], bool],
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        """Stores a result, and waits while the store is unreachable. Raises Cancelled once the job is not ``wanted``,
        and what ``pause`` raises."""
        if self.objects is None:
            return
        pause_s = FIRST_PAUSE_S
        for name, file in files.items():
            while True:
                if not wanted():
                    raise Cancelled
                try:
                    self.objects.put(f"{job_id}/{name}", self._path(job_id, name), file["sha256"])
                    break
                except (StoreUnavailable, StoreDenied) as error:  # the head is made: it waits for its operator, too
                    log.warning("a result waits for the store", reason=error.detail.text)
                pause(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def file(self, job_id: str, name: str, entry: FileEntry) -> StoredFile:
        """Returns a file of a result, fetched from the store if the data folder lacks it. Raises Unavailable if the
        store fails, Conflict if it lacks the file, and DiskFull."""
        path = self._path(job_id, name)
        try:
            if time.time() - path.stat().st_mtime > UNUSED_S:
                os.utime(path)  # it is used
        except FileNotFoundError:
            if self.objects is not None:
                self._fetch(job_id, name, entry, path)
        return StoredFile(path, entry["sha256"])

    def compare(self, job_id: str, files: Mapping[str, FileEntry]) -> None:
        """Reads a job's files anew and adds to ``damaged`` those whose content has changed."""
        for name, entry in files.items():
            path, said = self._path(job_id, name), f"{job_id}/{name}"
            self.damaged.discard(said)
            if path.is_file() and sha256_of(path) != entry["sha256"]:
                os.utime(path)  # whoever sends it reads it again
                log.error("a result is damaged", job_id=job_id, file=name)
                self.damaged.add(said)

    def link(self, job_id: str, name: str) -> str | None:
        """Returns a signed address of a file of a result, valid for ``LINK_S`` seconds; None if the store has no such
        addresses, or does not have the file yet. Raises Unavailable."""
        if self.objects is None:
            return None
        with suppress(ObjectMissing):
            return self.objects.link(f"{job_id}/{name}", Path(name).name, LINK_S)

    def folder(self, job_id: str, files: Mapping[str, FileEntry]) -> Path:
        """Returns the folder of a result with all its files. Raises what ``file`` raises."""
        for name, entry in files.items():
            self.file(job_id, name, entry)
        return self._store.folder("jobs", job_id) / "result"

    def erase(self, job_id: str) -> None:
        """Removes a result with all its versions in the store. Raises Unavailable if the store fails."""
        if self.objects is not None:
            self.objects.erase(f"{job_id}/")
        self._store.remove(self._store.folder("jobs", job_id))

    def discard(self, job_id: str) -> None:
        """Removes the result of a cancelled job; an unreachable store keeps it until the job is removed."""
        if self.objects is not None:
            with suppress(Refused):
                self.objects.erase(f"{job_id}/")
        shutil.rmtree(self._store.folder("jobs", job_id), ignore_errors=True)

    def bound(self, most: int, files_of: Callable[[str], Mapping[str, FileEntry]]) -> int:
        """Removes the least recently used large files from the data folder, until all of them take at most ``most``
        bytes. Each file is first compared with its object, and stored if the store lacks it. Returns their number."""
        if self.objects is None:
            return 0
        found, removed = sorted(self._large()), 0
        total = sum(size for _, size, *_ in found)
        for used, size, job_id, path in found:
            if total <= most or time.time() - used < UNUSED_S:
                break
            name = path.relative_to(self._store.folder("jobs", job_id) / "result").as_posix()
            try:
                self.objects.put(f"{job_id}/{name}", path, files_of(job_id)[name]["sha256"])
            except (EigenheadError, LookupError, OSError) as error:  # it runs, is being removed, or the store is away
                log.info("a result stays in the data folder", job_id=job_id, reason=str(error)[:200])
                continue
            path.unlink(missing_ok=True)
            total, removed = total - size, removed + 1
        return removed

    def _path(self, job_id: str, name: str) -> Path:
        return self._store.folder("jobs", job_id) / "result" / name

    def _fetch(self, job_id: str, name: str, entry: FileEntry, path: Path) -> None:
        assert self.objects is not None

        def admit(size: int) -> None:
            self._store.reserve(size, self._spare)

        with self._store.incoming() as folder:
            part = folder / "file"
            try:
                self.objects.fetch(f"{job_id}/{name}", part, entry["sha256"], admit)
            except ObjectMissing as error:
                raise Conflict("result-missing", compose("result-missing")) from error
            path.parent.mkdir(parents=True, exist_ok=True)
            part.replace(path)

    def _large(self) -> Iterator[tuple[float, int, str, Path]]:
        """Yields the last use, size, job and path of each large file."""
        for job_id in self._store.ids("jobs"):
            for path in (self._store.folder("jobs", job_id) / "result").rglob("*"):
                with suppress(FileNotFoundError):
                    said = path.stat()
                    if path.is_file() and said.st_size >= LARGE_BYTES:
                        yield said.st_mtime, said.st_size, job_id, path

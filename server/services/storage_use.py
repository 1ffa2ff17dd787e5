"""Counts the bytes that captures, results, caches and so on take in the data folder."""

import os
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from server.services.job_rows import STATUSES
from server.services.jobs import Jobs
from server.settings import ServiceSettings
from server.storage.job_index import JobQuery
from server.storage.store import Store

COUNT_AGAIN_S = 300.0  # between two looks through the data folder, which of a large one take long
FAILED = (*STATUSES["failed"], *STATUSES["cancelled"])

KINDS = {  # folders of the data folder, by what they hold
    "captures": ("captures",),
    "results": ("jobs",),
    "caches": ("cache",),
    "calibrations": ("calibrations",),
    "unfinished": ("incoming", "uploads", "trash"),
    "set aside": ("set-aside",),
    "rig": ("rig",),
}


@dataclass(frozen=True, slots=True)
class KindOfUse:
    """Holds how much disk space one kind of data takes. ``things``: how many captures, jobs and so on there are."""

    kind: str
    bytes: int
    things: int


@dataclass(frozen=True, slots=True)
class StorageUse:
    """Holds how the disk of the data folder is used; sizes are in bytes.

    ``free`` and ``total`` are the disk's, ``spare`` is what uploads and jobs must leave free. ``kinds`` is None until
    the data folder was counted, ``at`` is when that was (s since 1970). ``failed``: number of failed and cancelled
    jobs.
    """

    data: str
    free: int
    total: int
    spare: int
    kinds: tuple[KindOfUse, ...] | None
    at: float | None
    failed: int


class StorageCount:
    """Counts the bytes in the data folder in a thread of its own, since a large folder takes long. The count is kept
    for ``COUNT_AGAIN_S`` seconds."""

    def __init__(self, store: Store, jobs: Jobs, settings: ServiceSettings) -> None:
        self._store, self._jobs, self._settings = store, jobs, settings
        self._looking = threading.Lock()
        self._found: tuple[KindOfUse, ...] | None = None
        self._at: float | None = None

    def use(self) -> StorageUse:
        """Returns the last count and the disk's present free space. Starts a new count if the last is old, and does not
        wait for it."""
        old = self._at is None or time.time() - self._at > COUNT_AGAIN_S
        if old and self._looking.acquire(blocking=False):
            threading.Thread(target=self._look, args=(self._store.data,), daemon=True).start()
        disk = shutil.disk_usage(self._store.data)
        return StorageUse(
            str(self._store.data.resolve()),
            disk.free,
            disk.total,
            self._settings.free_bytes,
            self._found,
            self._at,
            self._jobs.page(JobQuery("", FAILED), limit=1).total,
        )

    def forget(self) -> None:
        """Marks the last count as old, so that the next call of ``use`` starts a new one."""
        self._at = None if self._found is None else 0.0

    def _look(self, data: Path) -> None:
        try:
            self._found, self._at = count(data), time.time()
        finally:
            self._looking.release()


def count(data: Path) -> tuple[KindOfUse, ...]:
    """Counts bytes and things in the data folder, by kind. The kind "other" is everything else in the folder, the
    database and models included."""
    known = {folder for folders in KINDS.values() for folder in folders}
    found = []
    for kind, folders in KINDS.items():
        places = [data / folder for folder in folders]
        found.append(KindOfUse(kind, sum(map(_bytes, places)), sum(len(_names(place)) for place in places)))
    rest = [data / name for name in _names(data) if name not in known]
    return (*found, KindOfUse("other", sum(map(_bytes, rest)), len(rest)))


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)  # noqa: PTH208 - names alone, of a hundred thousand
    except (FileNotFoundError, NotADirectoryError):
        return []


def _bytes(path: Path) -> int:
    return path.lstat().st_size if path.is_file() else sum(_sizes(path))


def _sizes(folder: Path) -> Iterator[int]:
    """Yields the sizes of all files below a folder but those removed meanwhile; links are not followed."""
    try:
        entries = os.scandir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return
    with entries:
        for entry in entries:
            try:
                if entry.is_dir(follow_symlinks=False):
                    yield from _sizes(Path(entry.path))
                else:
                    yield entry.stat(follow_symlinks=False).st_size
            except FileNotFoundError:
                continue

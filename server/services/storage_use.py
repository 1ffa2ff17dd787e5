"""Counts the bytes of captures, results, caches and other kinds in the data folder."""

import os
import shutil
import threading
import time
from pathlib import Path

from pydantic import Field

from server.services.answer import Answer
from server.services.job_rows import STATUSES
from server.services.jobs import Jobs
from server.settings import ServiceSettings
from server.storage.folders import folder_bytes
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


class KindOut(Answer):
    """Describes how much disk space one kind of data takes."""

    kind: str
    bytes: int
    things: int = Field(description="captures, jobs, ...: what lies directly in the kind's folders")


class StorageOut(Answer):
    """Describes how the disk of the data folder is used."""

    free: int = Field(description="bytes of the disk")
    total: int = Field(description="bytes of the disk")
    spare: int = Field(description="bytes that uploads and jobs leave free")
    failed: int = Field(description="jobs that failed or were cancelled")
    kinds: list[KindOut] | None = Field(description="null while the data folder is looked through for the first time")
    at: float | None = Field(description="when it was looked through, seconds since 1970")


class StorageCount:
    """Counts the bytes in the data folder in a separate thread, because a large folder takes long. The count is kept
    for ``COUNT_AGAIN_S`` seconds."""

    def __init__(self, store: Store, jobs: Jobs, settings: ServiceSettings) -> None:
        self._store, self._jobs, self._settings = store, jobs, settings
        self._looking = threading.Lock()
        self._found: list[KindOut] | None = None
        self._at: float | None = None

    def use(self) -> StorageOut:
        """Returns the last count and the disk's current free space. Starts a new count if the last count is old, and
        does not wait for its end."""
        old = self._at is None or time.time() - self._at > COUNT_AGAIN_S
        if old and self._looking.acquire(blocking=False):
            threading.Thread(target=self._look, args=(self._store.data,), daemon=True).start()
        disk = shutil.disk_usage(self._store.data)
        return StorageOut(
            free=disk.free,
            total=disk.total,
            spare=self._settings.free_bytes,
            failed=self._jobs.page(JobQuery("", FAILED), limit=1).total,
            kinds=self._found,
            at=self._at,
        )

    def forget(self) -> None:
        """Marks the last count as old, so that the next call of ``use`` starts a new one."""
        self._at = None if self._found is None else 0.0

    def _look(self, data: Path) -> None:
        try:
            self._found, self._at = count(data), time.time()
        finally:
            self._looking.release()


def count(data: Path) -> list[KindOut]:
    """Counts bytes and objects in the data folder, by kind. The kind "other" contains all remaining files, including
    the database and models."""
    known = {folder for folders in KINDS.values() for folder in folders}
    found = []
    for kind, folders in KINDS.items():
        places = [data / folder for folder in folders]
        things = sum(len(_names(place)) for place in places)
        found.append(KindOut(kind=kind, bytes=sum(map(_bytes, places)), things=things))
    rest = [data / name for name in _names(data) if name not in known]
    return [*found, KindOut(kind="other", bytes=sum(map(_bytes, rest)), things=len(rest))]


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)  # noqa: PTH208 - names alone, of a hundred thousand
    except (FileNotFoundError, NotADirectoryError):
        return []


def _bytes(path: Path) -> int:
    return path.lstat().st_size if path.is_file() else folder_bytes(path)

"""Maintains the object store of captures: sends waiting files, removes unreferenced ones, and limits the copies in the
data folder.

A data folder whose captures have no records belongs to a worker. A worker's data folder is only a cache, from which
erased captures are also removed.
"""

import time
from collections.abc import Callable
from contextlib import suppress

import structlog

from rig.errors import EigenheadError
from server.errors import Refused
from server.services.jobs import Jobs
from server.storage.folders import folder_bytes
from server.storage.records import CaptureRecord
from server.storage.store import Store

UNUSED_S = 3600.0  # the files of a job that runs were used since
SHARED_AT_ONCE = 50

log = structlog.get_logger()


def tend_captures(store: Store, jobs: Jobs, most: int) -> int:
    """Stores captures that wait for the store, removes unreferenced blobs, and limits the data folder. If the store
    does not answer, the next call continues. Returns how many blobs were removed."""
    blobs, removed = store.blobs, 0
    if blobs is None:
        return 0
    try:
        for identity in blobs.waiting(SHARED_AT_ONCE):
            record = store.found("captures", identity)
            if isinstance(record, CaptureRecord) and not store.share(record):
                break
        blobs.release_abandoned()
        removed = blobs.bury()
        if blobs.bytes_of_all() > most:  # or nobody need look at each file
            bound_captures(store, most, lambda identity: bool(jobs.active(capture=identity)))
    except Refused as error:
        log.info("captures wait for the store", reason=error.detail.text)
    return removed


def bound_captures(store: Store, most: int, is_used: Callable[[str], bool]) -> int:
    """Removes the least recently used large files of captures from the data folder, until all of them take at most
    ``most`` bytes. Each file is first compared with its stored object. Returns how many captures lost files."""
    assert store.blobs is not None
    found, total, removed = [], 0, 0
    for identity in store.ids("captures"):
        folder = store.folder("captures", identity) / "files"
        with suppress(FileNotFoundError):
            size = folder_bytes(folder)
            found.append((folder.stat().st_mtime, size, identity))
            total += size
    for used, size, identity in sorted(found):
        if total <= most or time.time() - used < UNUSED_S:
            break
        if is_used(identity):
            continue
        try:
            there = store.blobs.compare(identity, store.folder("captures", identity) / "files")
        except (EigenheadError, OSError) as error:
            log.info("a capture stays in the data folder", capture=identity, reason=str(error)[:200])
            continue
        for path in there.values():
            path.unlink(missing_ok=True)
        total, removed = total - size, removed + 1
    return removed


def forget_erased(store: Store) -> int:
    """Removes from a worker's data folder the captures that the service no longer has. Returns their number."""
    assert store.blobs is not None
    mine = {*store.ids("captures"), *store.ids("cache/captures")}
    mine = {identity for identity in mine if not (store.folder("captures", identity) / "record.json").exists()}
    gone = mine - store.blobs.holders(mine)
    for identity in gone:
        store.remove(store.folder("captures", identity))
        store.remove(store.cache_of(identity))
    return len(gone)

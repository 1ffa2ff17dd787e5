"""Removes unclaimed objects from a store: results of jobs that were removed while a worker still wrote, and results and
captures' files that a restored database lacks.

Several services may do this at once. The row of a job is written before its result, and the store is listed before the
rows are read, so a result with a job is never removed. A database collects only at the place of its own results, which
an object at the root of the store names.
"""

import time
from collections.abc import Callable, Collection
from pathlib import Path
from tempfile import TemporaryDirectory

import structlog

from rig.digest import sha256_of
from server.errors import Refused
from server.storage.database import portions
from server.storage.objects import ObjectMissing, ObjectStore
from server.storage.store import is_id

OWNER = "owner"
DAY_S = 86400.0
COLLECT_S = 6 * 3600.0  # between two looks at a whole store

log = structlog.get_logger()


def collect(
    objects: ObjectStore,
    owner: str,
    known: Callable[[Collection[str]], set[str]],
    days: float,
    scratch: Path,
    is_name: Callable[[str], object] = is_id,
) -> int:
    """Removes the results of jobs that are not known and were written more than ``days`` ago. ``owner`` names the
    database, ``known`` returns the ids that are its jobs, ``is_name`` returns whether a text may be an id. Returns the
    number of their jobs. If the store does not answer, the next call continues."""
    removed = 0
    try:
        if not _owns(objects, owner, scratch):
            return 0
        listed = [name for name in objects.folders() if is_name(name)]
        for some in portions(listed):
            for job_id in sorted({*some} - known(some)):
                written = max((entry.written for entry in objects.entries(f"{job_id}/")), default=0.0)
                if time.time() - written > days * DAY_S and not known([job_id]):  # submitted again under its id
                    removed += objects.erase(f"{job_id}/") > 0  # some stores go on listing empty folders
    except Refused as error:
        log.info("objects that nothing claims stay", reason=error.detail.text)
    return removed


def _owns(objects: ObjectStore, owner: str, scratch: Path) -> bool:
    """Returns whether the store's results are this database's; the first database that asks becomes their owner."""
    with TemporaryDirectory(dir=scratch) as folder:
        path = Path(folder) / OWNER
        try:
            objects.fetch(OWNER, path)
        except ObjectMissing:
            path.write_text(owner, encoding="utf-8")
            objects.put(OWNER, path, sha256_of(path))
        if (found := path.read_text(encoding="utf-8")) != owner:
            log.warning("this store is another database's; nothing is collected in it", owner=found[:64])
        return found == owner

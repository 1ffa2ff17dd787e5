"""Implements retention: removes old jobs, captures and caches by age, by count and by free space.

Retention never removes data that a queued or running job needs, or files that the service did not make itself. If the
clock has jumped, compared with the last sweep and the machine's uptime, nothing is removed until an operator has
intervened (``STOPPED``).

Retention also removes unreferenced data from object stores: results of jobs that were removed while a worker still
wrote, and results and captures' files that a restored database lacks. Several services may remove data from one store
at once. The row of a job is written before its result, and the store is listed before the rows are read, so a new
result is never mistaken for one without a job. Each database removes results only from its own store.
"""

import json
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import structlog
from pydantic import Field

from rig.errors import EigenheadError
from rig.files import sha256_of, write_atomically
from rig.messages.message import compose
from server.errors import NotFound, Refused
from server.services.answer import Answer, Moment
from server.services.deliveries import UNDER_WAY
from server.services.job_rows import DELIVERY, FINISHED, STATUSES
from server.services.records import moment_now, moment_of
from server.services.service import CheckOut, Service
from server.services.stored_captures import tend_captures
from server.storage.capture_blobs import NAME
from server.storage.database import database_identity, portions
from server.storage.folders import LAST_SWEEP, STOPPED, folder_bytes, newest
from server.storage.job_index import JobQuery
from server.storage.library import CaptureQuery
from server.storage.objects import ObjectMissing, ObjectStore
from server.storage.store import is_id

OWNER = "owner"  # the object that names the database whose results lie in a store
DAY_S = 86400.0
COLLECT_S = 6 * 3600.0  # between two looks at a whole store
LEFTOVER_S = 900.0  # a live upload or extraction touches its folder more often than that
BOOT = Path("/proc/sys/kernel/random/boot_id")
MANY = 20  # records: fewer may all be of one day, and due on one
ENDED = tuple(status for state in FINISHED for status in STATUSES[state])

log = structlog.get_logger()


def clear_caches(service: Service) -> int:
    """Removes the caches of all captures that no queued or running job needs. Caches are rebuilt on demand. Returns how
    many captures had a cache."""
    store, removed = service.store, 0
    for identity in store.ids("cache/captures"):
        if not service.jobs.active(capture=identity):
            store.remove(store.cache_of(identity))
            removed += 1
    return removed


def sweep(service: Service) -> dict[str, int]:
    """Removes everything that the settings no longer keep, and remains of crashes. Returns the number of removed
    objects of each kind: zero while the clock is in doubt. Results that are missing are noted for ``readiness``."""
    if not _trusts_clock(service):
        return {}
    gone = {"leftovers": service.store.sweep(LEFTOVER_S), "uploads": service.uploads.sweep()}
    gone["jobs"] = _jobs(service)
    gone["captures"] = _captures(service)
    gone["caches"] = _caches(service)
    gone["blobs"] = tend_captures(service.store, service.jobs, service.settings.captures_bytes)
    gone["results"] = service.jobs.results.bound(service.settings.results_bytes, service.jobs.files)
    gone["unclaimed"] = _unclaimed(service)
    gone["orphans"] = _orphans(service)
    gone["deliveries"] = _deliveries(service)
    _find_missing(service)
    if any(gone.values()):
        log.info("swept", **gone)
    return gone


def _trusts_clock(service: Service) -> bool:
    """Compares the clock with the last sweep's. Since the last sweep the clock may have advanced by at most a day more
    than the machine ran; after a restart of the machine any advance is accepted, unless half of all records, and at
    least ``MANY``, would be removed at once. A doubtful clock is noted in the file ``STOPPED`` until its removal."""
    stopped, path = service.settings.data / STOPPED, service.settings.data / LAST_SWEEP
    now, up, boot = time.time(), time.clock_gettime(time.CLOCK_BOOTTIME), BOOT.read_text().strip()
    with suppress(FileNotFoundError, ValueError, KeyError, TypeError):
        last = json.loads(path.read_bytes())
        passed = now - last["at"]
        if last["boot"] == boot:
            doubt = passed - (up - last["up"]) > DAY_S
        else:
            doubt = passed > 0 and _removes_half(service, passed)
        if doubt:
            why = compose("retention-stopped", days=passed / DAY_S, file=str(stopped)).text
            write_atomically(stopped, why.encode())
            log.error("nothing is removed", reason=why)
        elif last["boot"] != boot and passed < 0:  # a machine whose clock is not set yet
            return not stopped.exists()
    write_atomically(path, json.dumps({"at": now, "up": up, "boot": boot}).encode())
    return not stopped.exists()


def _removes_half(service: Service, passed_s: float) -> bool:
    s = service.settings
    ages: list[tuple[float | None, Iterable[str | None]]]
    ages = [(s.keep_captures_days, (record.created for record in service.store.captures()))]
    if s.keep_results_days is not None:
        finished = (job for state in FINISHED for job in service.jobs.find(state=state, limit=100_000))
        ages.append((s.keep_results_days, (job.finished or job.created for job in finished)))
    kept = [(days, [*made]) for days, made in ages if days is not None and passed_s > days * DAY_S]
    due = sum(_age_s(moment) > days * DAY_S for days, made in kept for moment in made)
    return due >= MANY and 2 * due > sum(len(made) for _, made in kept)


class UpcomingOut(Answer):
    """Describes a capture or finished job that retention will remove."""

    kind: Literal["job", "capture"]
    id: str
    label: str
    goes: Moment | None = Field(description="null where that hangs on the disk or on what comes")
    why: str = Field(description="the setting that takes it")


def upcoming(service: Service, limit: int = 10) -> list[UpcomingOut]:
    """Returns what retention will remove next if nothing is added: at most ``limit`` jobs, then at most ``limit``
    captures. Captures that a job needs are left out."""
    return [*_jobs_next(service, limit), *_captures_next(service, limit)]


def _jobs_next(service: Service, limit: int) -> list[UpcomingOut]:
    s = service.settings
    page = service.jobs.page(JobQuery("", ENDED, order="created"), limit)
    full = s.make_room and service.store.free_bytes() < s.free_bytes
    found = []
    for place, job in enumerate(page.items):
        many = s.keep_jobs is not None and page.total - place > s.keep_jobs
        if full or many:
            goes, why = moment_now(), "keep_jobs" if many else "make_room"
        elif s.keep_results_days is not None:
            goes, why = _later(job.finished or job.created, s.keep_results_days), "keep_results_days"
        elif s.make_room or s.keep_jobs is not None:
            goes, why = None, "make_room" if s.make_room else "keep_jobs"
        else:
            break
        found.append(UpcomingOut(kind="job", id=job.id, label=job.name, goes=goes, why=why))
    return found


def _captures_next(service: Service, limit: int) -> list[UpcomingOut]:
    days = service.settings.keep_captures_days
    if days is None:
        return []
    oldest = service.captures.page(CaptureQuery(order="created"), limit).items
    return [
        UpcomingOut(kind="capture", id=r.id, label=r.label, goes=_later(r.created, days), why="keep_captures_days")
        for r in oldest
        if not service.jobs.active(capture=r.id)
    ]


def _later(moment: str | None, days: float) -> str | None:
    return None if moment is None else moment_of(1000.0 * (datetime.fromisoformat(moment).timestamp() + days * DAY_S))


def _jobs(service: Service) -> int:
    s, removed = service.settings, 0
    if s.keep_results_days is None and s.keep_jobs is None and not s.make_room:
        return 0
    finished = [job for state in FINISHED for job in service.jobs.find(state=state, limit=100_000)]
    finished.sort(key=lambda job: job.created or "", reverse=True)
    for place in range(len(finished) - 1, -1, -1):  # oldest first
        job = finished[place]
        old = s.keep_results_days is not None and _age_s(job.finished or job.created) > s.keep_results_days * DAY_S
        many = s.keep_jobs is not None and place >= s.keep_jobs
        full = s.make_room and service.store.free_bytes() < s.free_bytes
        if not (old or many or full):
            break
        if job.delivery is not None and job.delivery.state in UNDER_WAY:
            continue
        with suppress(EigenheadError):
            service.jobs.delete(job.id)
            removed += 1
    return removed


def _captures(service: Service) -> int:
    days, removed = service.settings.keep_captures_days, 0
    if days is None:
        return 0
    for record in list(service.store.captures()):
        if _age_s(record.created) > days * DAY_S and not service.jobs.active(capture=record.id):
            with suppress(EigenheadError):  # the store is away
                service.store.remove_capture(record.id)
                removed += 1
    return removed


def _caches(service: Service) -> int:
    """Removes caches without a capture, and the least recently used ones if all are too large or the disk is full."""
    store, s = service.store, service.settings
    known, removed = set(store.ids("captures")), 0
    kept: list[tuple[float, int, Path]] = []
    for identity in store.ids("cache/captures"):
        folder = store.cache_of(identity)
        if identity not in known:
            store.remove(folder)
            removed += 1
            continue
        with suppress(FileNotFoundError):  # it is being erased
            kept.append((newest(folder), folder_bytes(folder), folder))
    total = sum(size for _, size, _ in kept)
    for _, size, folder in sorted(kept):
        if total <= s.cache_bytes and store.free_bytes() >= s.free_bytes:
            break
        store.remove(folder)
        total -= size
        removed += 1
    return removed


def _unclaimed(service: Service) -> int:
    """Removes unreferenced objects of this database from the stores, a few times a day."""
    days, results, blobs = service.settings.keep_unclaimed_days, service.jobs.results, service.store.blobs
    if days is None or time.monotonic() - results.collected < min(COLLECT_S, days * DAY_S):
        return 0
    results.collected, owner, removed = time.monotonic(), database_identity(service.engine), 0
    with service.store.incoming() as scratch:
        if results.objects is not None:
            removed += collect(results.objects, owner, service.jobs.index.known, days, scratch)
        if blobs is not None:
            removed += collect(blobs.objects, owner, blobs.known, days, scratch, NAME.fullmatch)
    return removed


def _orphans(service: Service) -> int:
    """Removes temporary folders of killed workers in ended jobs, and folders of unknown jobs."""
    removed = 0
    for job_id in service.store.ids("jobs"):
        folder = service.store.folder("jobs", job_id)
        attempts = list(folder.glob("attempt-*"))
        if not attempts or time.time() - max(path.stat().st_mtime for path in attempts) < LEFTOVER_S:
            continue
        if _ended(service, job_id):
            for path in attempts:
                service.store.remove(path)
                removed += 1
            with suppress(OSError):  # it has a result
                folder.rmdir()
    return removed


def _ended(service: Service, job_id: str) -> bool:
    try:
        return service.jobs.state(job_id) in FINISHED
    except NotFound:  # erased while its worker still wrote
        return True


def _deliveries(service: Service) -> int:
    """Removes webhook messages that were delivered, or given up, a day ago."""
    before = datetime.fromtimestamp(time.time() - DAY_S, UTC).isoformat()
    client = service.jobs.client
    rows = client.list_workflows(name=DELIVERY, completed_before=before, load_input=False, load_output=False)
    if rows:
        client.delete_workflows([row.workflow_id for row in rows])
    return len(rows)


def _find_missing(service: Service) -> None:
    """Finds results that somebody else removed or changed, or that are missing from a backup, for readiness. Each sweep
    compares the files of one job, in turn."""
    missing, done = service.jobs.without_result(), service.jobs.index.newest_first(STATUSES["succeeded"])
    damaged = service.jobs.results.damaged
    if done:
        job_id = done[int(time.time() / service.settings.sweep_s) % len(done)]
        with suppress(EigenheadError):  # removed, or missing
            service.jobs.results.compare(job_id, service.jobs.files(job_id))
    damaged.intersection_update({name for name in damaged if name.partition("/")[0] in done})
    detail, orphans = compose("results-complete"), service.jobs.orphans()
    if orphans:
        detail = compose("results-orphaned", count=len(orphans), jobs=orphans[:3])
    elif missing:
        detail = compose("results-missing", count=len(missing), jobs=missing[:3])
    elif damaged:
        detail = compose("file-damaged", files=sorted(damaged)[:3])
    service.known["results"] = CheckOut(ok=True, detail=detail)


def _age_s(moment: str | None) -> float:
    return time.time() - datetime.fromisoformat(moment).timestamp() if moment else 0.0


def collect(
    objects: ObjectStore,
    owner: str,
    known: Callable[[Collection[str]], set[str]],
    days: float,
    scratch: Path,
    is_name: Callable[[str], object] = is_id,
) -> int:
    """Removes the results of unknown jobs that were written more than ``days`` days ago. ``owner`` names the database,
    ``known`` returns which ids are jobs of it, and ``is_name`` says whether a name may be an id. Returns the number of
    jobs whose results were removed. If the store is unreachable, the removal stops, and the next call continues."""
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
    """Returns whether the store's results belong to this database; the first database that checks becomes the owner."""
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

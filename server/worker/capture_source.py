"""Finds the files of a capture for a worker: in the data folder, or after a wait in the store of captures.

A worker with its own data folder keeps fetched files up to ``captures_bytes`` and until the capture is erased; results
of its jobs are removed there, since they lie in the store.
"""

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import structlog
from sqlalchemy.exc import SQLAlchemyError

from rig.errors import Cancelled
from rig.messages.message import compose
from server.errors import Conflict, NotFound, Refused
from server.services.failures import JobFailed
from server.services.stored_captures import bound_captures, forget_erased
from server.settings import ServiceSettings
from server.storage.objects import StoreUnavailable
from server.storage.store import Store
from server.worker.pauses import insist, pause

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 15.0
TIDY_S = 30.0

log = structlog.get_logger()


class CaptureSource:
    """Gives a worker the files of captures. ``runs`` returns whether a job should still run."""

    def __init__(
        self, store: Store, settings: ServiceSettings, runs: Callable[[str], bool], stop: threading.Event
    ) -> None:
        self._store, self._settings, self._runs, self._stop = store, settings, runs, stop
        self._used = Counter[str]()

    def check(self, capture: str) -> None:
        """Raises JobFailed for a capture that does not exist, and if the disk has no room for a job."""
        try:
            record = self._store.found("captures", capture)
            if record is None and not (self._store.blobs and self._store.blobs.is_known(capture)):
                raise NotFound(compose("thing-capture"), capture)
            self._store.reserve(getattr(record, "bytes", 0), self._settings.free_bytes)
        except Refused as error:
            raise JobFailed(error.kind, error.detail) from error

    @contextmanager
    def files(self, job_id: str, capture: str) -> Iterator[Path]:
        """Yields the folder of a capture's files, which stay there during the block. Waits for a store that does not
        answer, and for a capture that is still being stored. Raises Cancelled, WorkerStopped, and JobFailed."""
        self._used[capture] += 1
        try:
            yield self._awaited(job_id, capture)
        finally:
            self._used[capture] -= 1

    def leave(self, job_id: str, capture: str) -> None:
        """Removes the folder of an ended job from the worker's own data folder."""
        if self._is_own and not (self._store.folder("captures", capture) / "record.json").exists():
            self._store.remove(self._store.folder("jobs", job_id))

    def tidy_forever(self) -> None:
        """Limits the size of the worker's own data folder every ``TIDY_S`` seconds, until the worker stops."""
        while self._is_own and not self._stop.wait(TIDY_S):
            try:
                forget_erased(self._store)
                bound_captures(self._store, self._settings.captures_bytes, self._is_busy)
            except (Refused, SQLAlchemyError, OSError) as error:
                log.info("captures stay in the data folder", reason=str(error)[:200])

    @property
    def _is_own(self) -> bool:
        """Returns whether the data folder of a capture without a record is the worker's own."""
        return self._store.blobs is not None and self._settings.results_store is not None

    def _is_busy(self, capture: str) -> bool:
        return self._used[capture] > 0 or (self._store.folder("captures", capture) / "record.json").exists()

    def _awaited(self, job_id: str, capture: str) -> Path:
        pause_s = FIRST_PAUSE_S
        while True:
            try:
                return insist(self._stop, lambda: self._store.capture_files(capture))
            except StoreUnavailable as error:
                log.warning("a job waits for its capture", reason=error.detail.text)
            except Conflict as error:  # it is being stored, or somebody removed it from the store
                if not insist(self._stop, lambda: self._is_expected(capture)):
                    raise JobFailed(error.kind, error.detail) from error
            except Refused as error:
                raise JobFailed(error.kind, error.detail, error.errors) from error
            if not self._runs(job_id):
                raise Cancelled
            pause(self._stop, pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def _is_expected(self, capture: str) -> bool:
        blobs = self._store.blobs
        return blobs is not None and not blobs.files(capture) and blobs.is_known(capture)

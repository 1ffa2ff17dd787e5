"""Sessions: one subject's captures, and their erasure."""

import time
from dataclasses import asdict, replace
from datetime import UTC, datetime

from server.errors import Unavailable
from server.services.jobs import FINISHED, Jobs
from server.services.records import Session
from server.storage.records import CaptureRecord, SessionRecord
from server.storage.store import Store, new_id

CANCEL_S = 5.0  # a cancelled job lets go of its files within one second


class Sessions:
    """The sessions of a service. Methods block."""

    def __init__(self, store: Store, jobs: Jobs) -> None:
        self._store, self._jobs = store, jobs

    def add(self, label: str, consent: str) -> Session:
        created = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        record = SessionRecord(new_id(), created, label, consent)
        self._store.save_session(record)
        return _with_captures(record, [])

    def find(self) -> list[Session]:
        """Newest first, each with the ids of its captures."""
        of: dict[str | None, list[str]] = {}
        for capture in self._store.captures():
            of.setdefault(capture.session, []).append(capture.id)
        return [_with_captures(record, of.get(record.id, [])) for record in self._store.sessions()]

    def get(self, identity: str) -> Session:
        """Raises NotFound."""
        record = self._store.session(identity)
        return _with_captures(record, [capture.id for capture in self._captures(identity)])

    def edit(self, identity: str, *, label: str | None = None, consent: str | None = None) -> Session:
        """Another label or consent note; what is None stays. Raises NotFound."""
        record = self._store.session(identity)
        new_label = record.label if label is None else label
        new_consent = record.consent if consent is None else consent
        self._store.save_session(replace(record, label=new_label, consent=new_consent))
        return self.get(identity)

    def erase(self, identity: str) -> None:
        """Cancels the jobs, then removes images, results, caches and what the job database holds of them. The session's
        own record goes last, so that an erasure that was cut short can be asked for again. Raises NotFound, and
        Unavailable while a worker still writes."""
        self._store.session(identity)
        captures = self._captures(identity)
        jobs = {job.id for job in self._jobs.find(session=identity, limit=100_000)}
        for capture in captures:
            jobs |= {job.id for job in self._jobs.find(capture=capture.id, limit=100_000)}
        active = [job for job in jobs if self._jobs.state(job) not in FINISHED]
        for job in jobs:
            self._jobs.cancel(job)
        self._await_workers(active)
        for job in jobs:
            self._delete_job(job)
        for capture in captures:
            self._store.remove_capture(capture.id)
        self._store.remove(self._store.folder("sessions", identity).with_suffix(".json"))

    def _await_workers(self, jobs: list[str]) -> None:
        """Until no worker writes to the jobs any more, each of which then lacks its attempt's folder: it would put back
        what is erased here. One that was killed will not write either, but leaves its folder."""
        deadline = time.monotonic() + CANCEL_S
        folders = [self._store.folder("jobs", job) for job in jobs]
        while any([*folder.glob("attempt-*")] for folder in folders) and time.monotonic() < deadline:
            time.sleep(0.05)

    def _delete_job(self, job_id: str) -> None:
        self._jobs.delete(job_id)
        if self._store.folder("jobs", job_id).exists():
            raise Unavailable("still-writing", "A worker still writes; ask for the erasure again.")

    def _captures(self, identity: str) -> list[CaptureRecord]:
        return [record for record in self._store.captures() if record.session == identity]


def _with_captures(record: SessionRecord, captures: list[str]) -> Session:
    return Session(**asdict(record), captures=tuple(captures))

"""Sessions: one subject's captures, and their erasure."""

from dataclasses import asdict, replace
from datetime import UTC, datetime

from server.services.erasure import erase_captures
from server.services.jobs import Jobs
from server.services.records import Session
from server.storage.records import CaptureRecord, SessionRecord
from server.storage.store import Store, new_id


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
        captures = [capture.id for capture in self._captures(identity)]
        jobs = {job.id for job in self._jobs.find(session=identity, limit=100_000)}
        erase_captures(self._store, self._jobs, captures, jobs)
        self._store.remove(self._store.folder("sessions", identity).with_suffix(".json"))

    def _captures(self, identity: str) -> list[CaptureRecord]:
        return [record for record in self._store.captures() if record.session == identity]


def _with_captures(record: SessionRecord, captures: list[str]) -> Session:
    return Session(**asdict(record), captures=tuple(captures))

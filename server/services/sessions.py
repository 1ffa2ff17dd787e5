"""Manages sessions (captures of one subject with a note of consent) and their erasure."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace

from server.errors import NotFound
from server.services.erasure import erase_captures
from server.services.jobs import Jobs
from server.services.records import PersonOut, SessionOut, moment_now
from server.services.texts import check_texts
from server.storage.library import Library, SubjectOrder, subject_of
from server.storage.pages import Page
from server.storage.records import SessionRecord
from server.storage.store import Store, new_id


class Sessions:
    """Manages the sessions of a service. Methods block, so call them from a thread."""

    def __init__(self, store: Store, jobs: Jobs, library: Library) -> None:
        self._store, self._jobs, self._library = store, jobs, library

    def add(self, label: str, consent: str) -> SessionOut:
        """Makes a session and returns it. ``consent`` is the note of the subject's consent, empty if there is none.
        Raises InputError for invalid texts."""
        check_texts({"label": label, "consent": consent})
        record = SessionRecord(new_id(), moment_now(), label, consent)
        self._store.add_session(record)
        return _with_captures(record, [])

    def page(self, sought: str = "", limit: int = 100, cursor: str | None = None) -> Page[SessionOut]:
        """Returns one page of the sessions in whose label or consent note all words of ``sought`` occur, newest first.
        Raises InputError for a cursor of another list."""
        page = self._library.sessions(sought, limit, cursor)
        captures = self._library.captures_of(page.items)
        records = [record for identity in page.items if (record := self._record(identity)) is not None]
        return page.of(_with_captures(record, captures[record.id]) for record in records)

    def subjects(
        self,
        sought: str = "",
        order: SubjectOrder = "-created",
        limit: int = 100,
        cursor: str | None = None,
        *,
        tag: str | None = None,
    ) -> Page[PersonOut]:
        """Returns one page of subjects. Sessions with the same label are one subject. ``tag``: only subjects with a
        capture that has this tag. Raises InputError for a cursor of another list."""
        page = self._library.subjects(sought, order, limit, cursor, tag)
        captures = self._library.captures_of([session for sessions in page.items for session in sessions])
        all_captures = [capture for some in captures.values() for capture in some]
        jobs, tags = self._jobs.of_captures(all_captures), self._library.tags_of(all_captures)
        found = []
        for sessions in page.items:
            records = [record for session in sessions if (record := self._record(session)) is not None]
            if records:
                theirs = {capture: jobs[capture] for session in sessions for capture in captures[session]}
                theirs_tags = {tag.casefold(): tag for capture in theirs for tag in tags.get(capture, ())}
                found.append(_subject(records, theirs, list(theirs_tags.values())))
        return page.of(found)

    def captures_of_subject(self, session: str | None) -> list[str]:
        """Lists the ids of all captures of a session's subject, including those of other sessions. The list is empty
        for None and for an unknown session."""
        if session is None or (record := self._record(session)) is None:
            return []
        sessions = self._library.sessions_of(subject_of(record))
        return [capture for some in self._library.captures_of(sessions).values() for capture in some]

    def _record(self, identity: str) -> SessionRecord | None:
        """Returns a session's record; None if it was removed after the index was read."""
        with suppress(NotFound):
            return self._store.session(identity)
        return None

    def get(self, identity: str) -> SessionOut:
        """Returns a session with the ids of its captures. Raises NotFound."""
        record = self._store.session(identity)
        return _with_captures(record, self._library.captures_of([identity])[identity])

    def edit(self, identity: str, *, label: str | None = None, consent: str | None = None) -> SessionOut:
        """Changes the label or the consent note of a session; None leaves it as it is. Raises NotFound, and InputError
        for invalid texts."""
        check_texts({"label": label, "consent": consent})
        changes = {name: text for name, text in (("label", label), ("consent", consent)) if text is not None}
        record = self._store.change_session(identity, lambda old: replace(old, **changes))
        return _with_captures(record, self._library.captures_of([identity])[identity])

    def erase(self, identity: str) -> None:
        """Cancels the jobs of a session, then removes every trace of it: pictures, results, caches and rows of the job
        database.

        The session's record is removed last, so an interrupted erasure can be repeated. Captures that arrive during the
        erasure are removed too. Raises NotFound, and Unavailable while a worker still writes results of the session.
        """
        self._store.session(identity)
        self._erase_captures(identity)
        self._store.remove_session(identity)
        self._erase_captures(identity)  # what was being taken or uploaded meanwhile; from now on nothing can be
        self._library.scrub()

    def _erase_captures(self, session: str) -> None:
        captures = self._library.captures_of([session])[session]
        jobs = {job.id for job in self._jobs.find(session=session, limit=100_000)}
        erase_captures(self._store, self._jobs, captures, jobs)


def _with_captures(record: SessionRecord, captures: list[str]) -> SessionOut:
    return SessionOut(**asdict(record), captures=captures)


def _subject(
    records: Sequence[SessionRecord], jobs: Mapping[str, Sequence[tuple[str, str]]], tags: list[str]
) -> PersonOut:
    """``records``: a person's sessions, newest first; ``jobs``: id and state of those of each capture."""
    all_jobs = sorted(((job, state, capture) for capture, some in jobs.items() for job, state in some), reverse=True)
    heads = [job for job, state, _ in all_jobs if state == "succeeded"]
    return PersonOut(
        id=records[0].id,
        label=records[0].label,
        created=records[0].created,
        sessions=[record.id for record in records],
        captures=len(jobs),
        heads=len(heads),
        running=sum(state in ("queued", "running") for _, state, _ in all_jobs),
        head=heads[0] if heads else None,
        capture=next(iter(jobs), None),
        consent=all(record.consent.strip() for record in records),
        tags=tags,
    )

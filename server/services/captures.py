"""Manages captures: takes them with the rig or makes them from archives, searches, changes and removes them, and stores
their feature points."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from pydantic import TypeAdapter

from rig.acquisition.face_sighting import face_remarks
from rig.acquisition.shot import ShotDocument, read_fault
from rig.acquisition.verdict import ViewDocument, remove_consequences, verdict_of
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.captures.archive import ArchiveLimits
from rig.messages.message import compose
from server.errors import Conflict, NotFound
from server.services.erasure import HoldingsOut, erase_captures
from server.services.job_rows import FINISHED
from server.services.jobs import Jobs
from server.services.records import moment_now
from server.services.rigs import SHOT_BYTES, RigBackend, SimulatedRig
from server.services.texts import check_texts, checked_tags, typed_tags
from server.services.work import check_kind
from server.settings import ServiceSettings
from server.storage.folders import folder_bytes
from server.storage.library import CaptureQuery, Library
from server.storage.pages import Page
from server.storage.records import CaptureContent, CaptureRecord
from server.storage.store import Store, StoredFile, new_id
from server.tasks.child import ChildProcessPool, WorkFailed
from server.tasks.ingest import Points, check_features, ingest_archive, ingest_board, ingest_folder

SAMPLE_SEED = 11
POINTS = TypeAdapter(Points)


@dataclass(frozen=True, slots=True)
class CaptureMetadata:
    """Holds people's notes on a capture: its session, label, the subject's expression, and tags. Raises InputError for
    texts that are too long or hold control characters."""

    session: str | None = None
    label: str = ""
    expression: str = ""
    tags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_texts({"session": self.session, "label": self.label, "expression": self.expression})

    @classmethod
    def of(cls, fields: Mapping[str, str | None]) -> "CaptureMetadata":
        """Reads the metadata from the fields of a form, in which tags are separated by commas. Raises InputError for
        invalid texts and tags."""
        tags = typed_tags(fields.get("tags") or "")
        return cls(fields.get("session") or None, fields.get("label") or "", fields.get("expression") or "", tags)


class Captures:
    """Manages the captures of a service. Methods block, so call them from a thread."""

    def __init__(
        self,
        store: Store,
        jobs: Jobs,
        rig: RigBackend,
        children: ChildProcessPool,
        settings: ServiceSettings,
        library: Library,
    ) -> None:
        self._store, self._jobs, self._rig, self._children = store, jobs, rig, children
        self._settings, self._library = settings, library

    def take(self, about: CaptureMetadata, *, seed: int | None = None, board: bool = False) -> CaptureRecord:
        """Takes a shot with the rig, checks its pictures in a child process and stores it as a capture.

        ``board``: the shot shows the calibration board; it needs no consent and gets no verdict. ``seed`` chooses the
        subject of the simulated studio. Raises DiskFull, Unavailable naming the missing pictures, InputError for a seed
        of a real rig, NotFound for an unknown session, and Conflict if consent is missing.
        """
        self._store.reserve(SHOT_BYTES, self._settings.free_bytes)
        self._check_consent(about.session, board=board)
        return self._shoot(self._rig, about, seed, board=board)

    def sample(self) -> CaptureRecord:
        """Takes a shot of the simulated studio, even if the service has a real rig. A simulated shot shows no real
        person, so no consent is needed. Raises Unavailable and DiskFull."""
        self._store.reserve(SHOT_BYTES, self._settings.free_bytes)
        studio = SimulatedRig(self._store.data / "rig" / "none")
        try:
            about = CaptureMetadata(label="Sample, simulated studio")
            return self._shoot(studio, about, SAMPLE_SEED, consent=False)
        finally:
            studio.close()

    def _shoot(
        self, rig: RigBackend, about: CaptureMetadata, seed: int | None, *, board: bool = False, consent: bool = True
    ) -> CaptureRecord:
        with self._store.incoming() as folder:
            capture = folder / "capture"
            shot = rig.capture(capture, seed=seed, board=board)
            with self._children.one() as child:
                ingest = child.remote(ingest_board if board else ingest_folder)
                judged = {} if board else {"measured": "checks" in shot}
                content = ingest(folder=str(capture / "files"), image_pixels=self._settings.image_pixels, **judged)
            return self._add(capture, "rig", content, about, shot, needs_consent=consent)

    def accept(self, archive: Path, folder: Path, about: CaptureMetadata) -> CaptureRecord:
        """Makes a capture from a received archive, which is unpacked and checked in a child process.

        ``folder`` is a folder of ``Store.incoming``; it must be on the file system of the data folder. Raises
        InputError naming every fault, DiskFull, NotFound for an unknown session, and Conflict if consent is missing.
        """
        self._check_consent(about.session)
        limits = self.archive_limits(archive)
        (folder / "capture").mkdir()
        with self._children.one() as child:
            content = child.remote(ingest_archive)(
                archive=str(archive),
                folder=str(folder / "capture" / "files"),
                limits=limits,
                image_pixels=self._settings.image_pixels,
            )
        return self._add(folder / "capture", "upload", content, about)

    def archive_limits(self, archive: Path) -> ArchiveLimits:
        """Returns how many files an archive may hold and how large they may be when unpacked. Raises DiskFull if the
        disk has no room for the archive."""
        self._store.reserve(archive.stat().st_size, self._settings.free_bytes)
        s = self._settings
        return ArchiveLimits(members=s.archive_members, total_bytes=s.archive_bytes, ratio=s.archive_ratio)

    def page(self, query: CaptureQuery, limit: int = 100, cursor: str | None = None) -> Page[CaptureRecord]:
        """Returns one page of the captures that match a query, ``limit`` at most. ``cursor`` is the field ``next`` of
        the page before. Raises InputError for a cursor of another list."""
        page = self._library.captures(query, limit, cursor)
        return page.of(self.of(page.items))

    def of(self, ids: Sequence[str]) -> list[CaptureRecord]:
        """Returns the captures with these ids, in their order; ids of no capture are left out."""
        found = []
        for identity in ids:
            with suppress(NotFound):  # removed since the index was asked, or damaged
                found.append(self._store.capture(identity))
        return found

    def newest(self) -> CaptureRecord | None:
        """Returns the newest capture; None if there is none."""
        return next(iter(self.page(CaptureQuery(), limit=1).items), None)

    def edit(
        self, identity: str, changes: Mapping[str, str | None], *, tags: Sequence[str] | None = None
    ) -> CaptureRecord:
        """Changes the label, expression, session or tags of a capture. Fields that ``changes`` does not name stay, and
        so do the tags if ``tags`` is None. Raises NotFound for an unknown capture or session, and InputError for
        invalid texts and tags."""
        check_texts({name: changes.get(name) for name in ("label", "expression")})
        checked = None if tags is None else checked_tags(tags)
        if changes.get("session") is not None:
            self._store.session(str(changes["session"]))

        def change(record: CaptureRecord) -> CaptureRecord:
            return replace(
                record,
                session=changes.get("session", record.session),
                label=changes.get("label", record.label) or "",
                expression=changes.get("expression", record.expression) or "",
                tags=record.tags if checked is None else checked,
            )

        return self._store.change_capture(identity, change)

    def tag(self, identity: str, tags: Sequence[str]) -> CaptureRecord:
        """Adds tags to a capture. Raises NotFound, and InputError for invalid tags and if the capture would have too
        many tags."""
        return self._store.change_capture(identity, lambda r: replace(r, tags=checked_tags([*r.tags, *tags])))

    def untag(self, identity: str, tags: Sequence[str]) -> CaptureRecord:
        """Removes tags from a capture, ignoring case. Raises NotFound, and InputError for invalid tags."""
        gone = {tag.casefold() for tag in checked_tags(tags)}

        def change(record: CaptureRecord) -> CaptureRecord:
            return replace(record, tags=tuple(tag for tag in record.tags if tag.casefold() not in gone))

        return self._store.change_capture(identity, change)

    def tags(self, limit: int = 200) -> list[str]:
        """Returns the tags of all captures, the most frequent first, ``limit`` at most."""
        return self._library.tags(limit)

    def image(self, identity: str, kind: str, camera: str) -> StoredFile:
        """Returns a camera's picture of one kind ("images", "background"). The path comes from the capture's record,
        never from the request. Raises NotFound."""
        record = self._store.capture(identity)
        name = picture_name(record, kind, camera)
        return StoredFile(self._store.capture_files(identity) / name, record.inputs[name])

    def features(self, identity: str) -> Points:
        """Returns the stored feature points of a capture, in pixels, by point and camera. Returns an empty mapping if
        no points were stored. Raises NotFound for an unknown capture and if the points' file is missing or damaged."""
        if not self._store.capture(identity).features:
            return {}
        path = self._store.folder("captures", identity) / "files" / "features.json"
        try:
            return POINTS.validate_python(json.loads(path.read_bytes())["points"])
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise NotFound(compose("thing-feature-points"), identity, compose("hint-put-again")) from error

    def put_features(self, identity: str, points: Points) -> CaptureRecord:
        """Checks feature points (pixels, by point and camera) against the cameras of a shot and stores them in place of
        earlier points. Raises NotFound, Conflict for the calibration board and for a film, and InputError naming every
        point that does not fit."""
        check_kind(self._store.capture(identity))
        folder = self._store.capture_files(identity)
        try:
            with self._children.one() as child:
                data = child.remote(check_features)(folder=str(folder), points=points)
        except (InputError, WorkFailed):
            self._store.capture(identity)  # removed while its cameras were read
            raise

        def change(record: CaptureRecord) -> CaptureRecord:
            write_atomically(folder / "features.json", data, parents=False)
            inputs = dict(sorted({**record.inputs, "features.json": hashlib.sha256(data).hexdigest()}.items()))
            return replace(record, inputs=inputs, features=True)

        return self._store.change_capture(identity, change)

    def check_unused(self, identity: str) -> CaptureRecord:
        """Returns the record of a capture that no queued or running job needs. Raises NotFound, and Conflict naming the
        jobs that need the capture."""
        record = self._store.capture(identity)
        if active := self._jobs.active(capture=identity):
            named = [compose("job-named", job=job) for job in active]
            raise Conflict("capture-in-use", compose("capture-in-use"), named)
        return record

    def remove(self, identity: str) -> None:
        """Removes a capture with its pictures and caches. The capture's jobs and their results stay. Raises NotFound,
        and Conflict while a queued or running job needs the capture."""
        self.check_unused(identity)
        self._store.remove_capture(identity)

    def holdings(self, identity: str) -> HoldingsOut:
        """Returns which data a removal of the capture would delete and which would stay. Raises NotFound."""
        record = self._store.capture(identity)
        of_capture = self._jobs.find(capture=identity, limit=100_000)
        here = folder_bytes(self._store.folder("captures", identity))  # the store may hold more
        return HoldingsOut(
            pictures=len(record.cameras) * max(record.frames, 1),
            bytes=max(record.bytes, here) + folder_bytes(self._store.cache_of(identity)),
            heads=[job.id for job in of_capture if job.state == "succeeded"],
            head_bytes=sum(file.bytes for job in of_capture for file in job.files.values()),
            jobs=[job.id for job in of_capture if job.state != "succeeded"],
            active=[job.id for job in of_capture if job.state not in FINISHED],
        )

    def erase(self, identity: str) -> None:
        """Cancels the jobs of a capture, then removes every trace of it: pictures, heads, caches and rows of the job
        database.

        An interrupted erasure can be repeated. Raises NotFound, and Unavailable while a worker still writes a result.
        """
        self._store.capture(identity)
        erase_captures(self._store, self._jobs, [identity])
        self._library.scrub()

    def _check_consent(self, session: str | None, *, board: bool = False) -> None:
        """Raises NotFound for an unknown session, and Conflict if the service requires consent and the session has no
        note of it; a shot of the ``board`` needs no consent."""
        consent = "" if session is None else self._store.session(session).consent
        if self._settings.ask_consent and not consent.strip() and not board:
            raise Conflict("consent-missing", compose("consent-missing"))

    def _add(
        self,
        folder: Path,
        source: str,
        content: CaptureContent,
        about: CaptureMetadata,
        shot: Mapping[str, object] | None = None,
        *,
        needs_consent: bool = True,
    ) -> CaptureRecord:
        if needs_consent:
            self._check_consent(about.session, board=content.board)
        # Pictures of the simulated studio, whose shots have no checks, are judged like those of an upload.
        taken = cast(ShotDocument, shot) if shot is not None and "checks" in shot else None
        at_shot = [] if taken is None else [read_fault(document) for document in taken["faults"]]
        faults = tuple(remove_consequences([*at_shot, *content.faults]))
        checks = {} if taken is None else taken["checks"]
        of_views = {name: {**checks.get(name, {}), **view} for name, view in content.checks.items()}
        self._store.put_checks(folder, cast(dict[str, ViewDocument], of_views))
        record = CaptureRecord(
            id=new_id(),
            created=moment_now(),
            source=source,
            session=about.session,
            label=about.label,
            expression=about.expression,
            cameras=content.cameras,
            front=content.front,
            inputs=content.inputs,
            bytes=content.bytes,
            board=content.board,
            frames=content.frames,
            features="features.json" in content.inputs,
            shot=shot,
            verdict=None
            if content.board or content.frames
            else verdict_of(faults, [camera.name for camera in content.cameras]),
            faults=faults,
            warnings=(*content.warnings, *face_remarks(content.face, faults)),
            tags=about.tags,
        )
        self._store.add_capture(folder, record)
        try:
            if about.session is not None:
                self._store.session(about.session)
        except NotFound:  # erased while this was taken
            self._store.remove_capture(record.id, later=True)
            raise
        return record


def picture_name(record: CaptureRecord, kind: str, camera: str) -> str:
    """Returns the name of a camera's picture of one kind ("images", "background"), the first one of several. Raises
    NotFound."""
    for name in record.inputs:
        path = Path(name)
        single = path.parent.name == kind and path.stem == camera
        if single or (path.parent.name == camera and path.parent.parent.name == kind):
            return name
    raise NotFound(compose("thing-camera-file"), camera, compose("hint-capture-inputs"))

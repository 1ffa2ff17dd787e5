"""Converts captures and sessions to the entries of the lists on pages."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import cast

from rig.acquisition.shot import CameraSyncDocument, SyncDocument
from rig.messages.message import compose, documents_of
from server.console.page import shared
from server.console.removal import removals
from server.errors import NotFound
from server.services.records import SessionOut
from server.services.service import Service
from server.storage.records import CaptureRecord, JsonObject
from server.tasks.simulate import SimulatedCertificate, SimulatedSync

OF_RECORD = (
    *("id", "created", "source", "label", "expression", "front"),
    *("features", "bytes", "session", "board", "verdict"),
)
SESSIONS_SHOWN = 200  # newest ones, in lists to choose from; older ones are found on the page Subjects


def jobs_of(service: Service, captures: Sequence[str]) -> dict[str, list[JsonObject]]:
    """Returns the jobs of each capture, newest first, with the progress (0 to 1) of those that run. Jobs that are being
    removed are left out."""
    found = service.jobs.of_captures(captures)
    running = [job for jobs in found.values() for job, state in jobs if state == "running"]
    progress = {job.id: job.progress for job in service.jobs.of(running)}
    return {
        capture: [
            {"id": job, "state": state, "progress": progress.get(job)} for job, state in jobs if job not in removals
        ]
        for capture, jobs in found.items()
    }


def capture_line(record: CaptureRecord, jobs: list[JsonObject]) -> JsonObject:
    """Converts a capture's record to an entry of a list. ``jobs``: the capture's jobs, as ``jobs_of`` returns them;
    ``size``: of the first camera's pictures (px); ``sizes``: width and height by camera."""
    return {
        **{name: getattr(record, name) for name in OF_RECORD},
        "cameras": [camera.name for camera in record.cameras],
        "jobs": jobs,
        "size": asdict(record.cameras[0]),
        "sizes": {camera.name: (camera.width, camera.height) for camera in record.cameras},
        "faults": [fault.document() for fault in record.faults],
        "warnings": documents_of(record.warnings),
        "sync": None if record.shot is None else sync_line(record.shot),
        "tags": [*record.tags],
    }


def sync_line(shot: Mapping[str, object]) -> JsonObject:
    """Returns a sentence on how nearly the pictures of a shot show the same moment, and whether they do (``good``).
    ``shot`` is the shot's certificate."""
    lines = sync_of(shot)
    late = sorted(name for name, line in lines.items() if line["status"] not in ("in sync", "recorded"))
    if late:
        return {"message": compose("not-in-sync", cameras=late).document(), "good": False}
    spread_ms = cast(SyncDocument, shot["sync"])["spread_ms"] if "sync" in shot else None
    if spread_ms is None:
        return {"message": compose("cameras-in-sync", count=len(lines)).document(), "good": True}
    within = compose("cameras-in-sync-within", count=len(lines), spread_ms=spread_ms)
    return {"message": within.document(), "good": True}


def sync_of(shot: Mapping[str, object]) -> Mapping[str, CameraSyncDocument | SimulatedSync]:
    """Returns the sync status and skew of each camera from the certificate of a shot, of a real rig or of the simulated
    studio."""
    certificate = cast(SyncDocument | SimulatedCertificate, shot.get("sync", shot))
    return certificate.get("cameras", {})


def sessions_list(service: Service, chosen: str | None = None) -> list[JsonObject]:
    """Returns the newest ``SESSIONS_SHOWN`` sessions, newest first, and the session ``chosen`` even if it is older."""

    def make() -> list[SessionOut]:
        return [*service.sessions.page(limit=SESSIONS_SHOWN).items]

    sessions = shared.get("sessions", 0.5, make)
    if chosen and all(session.id != chosen for session in sessions):
        with suppress(NotFound):
            sessions = [*sessions, service.sessions.get(chosen)]
    return [session_line(session) for session in sessions]


def session_line(session: SessionOut) -> JsonObject:
    """Converts a session to an entry of a list. ``captures`` counts them, without those that are being removed."""
    return session.model_dump() | {"captures": sum(capture not in removals for capture in session.captures)}

"""Implements the page of the rig: a live picture of each camera with exposure, sharpness, sync and calibration; clean
plates; the trigger."""

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import cast

from pipeline.results.report_types import Report
from rig.acquisition.plates import PlatesVersion
from rig.messages.message import Message, compose, documents_of
from server.console.media import live_view
from server.console.page import Action, Page, serve_page, shared, shown_detail
from server.console.pages.calibration import known_calibrations
from server.console.pages.captures import (
    capture_line,
    chosen_work,
    discard,
    edit_consent,
    new_session,
    sessions_list,
    sync_of,
)
from server.console.removal import removals
from server.errors import Conflict, NotFound
from server.services.captures import CaptureMetadata
from server.services.service import Service
from server.storage.records import JsonObject


class RigPage(Page, component="rig.js"):
    """Shows the rig: live pictures, state, calibration and clean plates, and the shot that was just taken."""

    def look(self) -> JsonObject:
        """Returns the state of the rig, the shot that awaits the operator's decision, and the job that was last started
        here."""
        state: JsonObject = shared.get("rig", 0.4, lambda: rig_state(self.service))
        job = job_strip(self.service, self.choice.get("job"))
        return {**state, "shot": shot_taken(self.service, self.choice.get("shot")), "job": job}


def job_strip(service: Service, identity: str | None) -> JsonObject | None:
    """Returns the shown fields of a job, with ``detail``: why the job failed or cannot begin. Returns None if there is
    no such job or it is being removed."""
    jobs = service.jobs.of([identity]) if identity is not None and identity not in removals else []
    if not jobs:
        return None
    job = jobs[0]
    detail = shown_detail(job.error.detail) if job.error is not None else job.notice
    shown = job.model_dump(include={"id", "state", "stage", "progress", "eta_s"})
    return shown | {"detail": None if detail is None else detail.document()}


def shot_taken(service: Service, identity: str | None) -> JsonObject | None:
    """Returns the capture that awaits the operator's decision to keep it; None if no capture does or it was removed."""
    if identity is None or identity in removals:
        return None
    with suppress(NotFound):
        return capture_line(service.store.capture(identity), [])
    return None


def rig_state(service: Service) -> JsonObject:
    """Returns the part of the page beside the live pictures, which is the same for all callers: drivers, the last
    shot's sync, moved cameras, calibration and clean plates."""
    rig = service.rig.describe()
    last = service.captures.newest()
    sync = {} if last is None or last.shot is None else sync_of(last.shot)
    moved = moved_cameras(service)
    cameras = [
        camera.model_dump() | {"sync": sync.get(camera.name), "moved": camera.name in moved} for camera in rig.cameras
    ]
    return {
        "kind": rig.kind,
        "ready": rig.ready,
        "cameras": cameras,
        "faults": documents_of([*rig.faults, *(fault for fault in [live_view(service).fault] if fault)]),
        "calibration": rig.calibration,
        "in_use": calibration_in_use(service),
        "sessions": sessions_list(service),
        "last": None if last is None else {"id": last.id, "created": last.created, "source": last.source},
        "plates": plates_shown(service.rig.plates()),
        "ask_consent": service.settings.ask_consent,
    }


def plates_shown(versions: list[PlatesVersion]) -> JsonObject | None:
    """Returns when the clean plates in use were taken, the previous version, and a newer refused version, given all
    versions, newest first. Returns None if no clean plates are in use, as in the simulated studio."""
    in_use = next((version for version in versions if version.in_use), None)
    if in_use is None:
        return None
    before = next((version for version in versions if not version.in_use and not version.refused), None)
    refused = versions[0] if versions[0].refused and not versions[0].in_use else None
    return {"taken": in_use.taken, "before": _plates_line(before), "refused": _plates_line(refused)}


def _plates_line(version: PlatesVersion | None) -> JsonObject | None:
    return (
        None if version is None else {"id": version.id, "taken": version.taken, "faults": documents_of(version.refused)}
    )


def calibration_in_use(service: Service) -> JsonObject | None:
    """Returns label, time and RMS reprojection error (px) of the calibration in use; None if this service did not make
    that calibration."""
    if service.calibrations.in_use() is None:
        return None
    used = next((one for one in known_calibrations(service, 2.0) if one.in_use), None)
    return used and {"label": used.label, "created": used.created, "rms_px": used.figures.get("rms_px")}


def moved_cameras(service: Service) -> set[str]:
    """Returns the cameras that have moved according to the warnings of the newest result."""
    done = service.jobs.find(state="succeeded", limit=1)
    if not done:
        return set()
    report = read_report(service, done[0].id)
    if report is None:
        return set()
    text = " ".join(w["message"] for w in report.get("warnings", []) if "moved" in w["code"])
    return {name for name in report.get("cameras", {}) if name in text}


def read_report(service: Service, job_id: str) -> Report | None:
    """Reads report.json of a finished job; None if it is missing. Reports are cached, since results never change."""
    path = service.store.folder("jobs", job_id) / "result" / "report.json"

    def read() -> Report | None:
        return cast(Report, json.loads(path.read_text())) if path.is_file() else None

    return shared.get(("report", job_id), 3600.0, read)


def capture(page: Page, event: Mapping[str, str | None]) -> Message:
    """Takes a shot and shows it, so that the operator can decide whether to keep it."""
    record = page.service.captures.take(CaptureMetadata.of(event))
    page.choice["shot"] = record.id
    shared.forget("rig")
    pictures = len(record.cameras)
    if record.verdict is None:
        return compose("captured", pictures=pictures)
    return compose("captured-verdict", pictures=pictures, verdict=record.verdict)


def keep(page: Page, event: object) -> None:
    """Keeps the shot that was just taken, and stops showing it for a decision."""
    page.choice["shot"] = None


def retake(page: Page, event: JsonObject) -> None:
    """Removes the shot that was shown for a decision, after the time to undo, while the page counts down to the next
    shot."""
    discard(page, event)
    page.choice["shot"] = None


def reconstruct_shot(page: Page, event: JsonObject) -> Message:
    """Keeps the shot and queues a job for it, whose head opens when it is ready. Raises what ``Jobs.submit`` raises."""
    job = page.service.jobs.submit(event["id"], chosen_work(event), key=page.caller.key)
    page.choice |= {"shot": None, "job": job.id}
    page.started(job.id, opens=True)
    return compose("job-queued", job=job.id[-6:])


def plates(page: Page, event: object) -> Message | None:
    """Takes clean plates of the empty studio. Returns None if the clean plates show a person; the page then asks
    whether to use them. Raises DiskFull and Unavailable."""
    page.service.store.reserve(0, page.service.settings.free_bytes)
    try:
        taken = page.service.rig.take_background()
    except Conflict:  # the page asks what is to become of them
        return None
    finally:
        shared.forget("rig")
    if taken.note is None:
        return compose("plates-taken", plates=taken.plates, cameras=len(taken.cameras))
    return compose("plates-taken-note", plates=taken.plates, cameras=len(taken.cameras), note=taken.note)


def use_plates(page: Page, event: JsonObject) -> Message:
    """Starts to use a stored version of the clean plates. Raises NotFound and Unavailable."""
    page.service.rig.use_plates(event["id"])
    shared.forget("rig")
    return compose("plates-taken-into-use")


RigPage.actions = {
    "capture": Action("capture", capture),
    "plates": Action("capture", plates),
    "use_plates": Action("capture", use_plates),
    "keep": Action("read", keep),
    "new_session": Action("capture", new_session),
    "edit_session": Action("capture", edit_consent),
    "retake": Action("capture", retake),
    "reconstruct": Action("submit", reconstruct_shot),
}


serve_page("rig", RigPage, choices=("job", "shot"), paths=("/",))

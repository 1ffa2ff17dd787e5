"""Jobs: the queue, stage and progress, log, cancel, restart with other settings; what a finished one says of itself."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import NotRequired, TypedDict, cast

from nicegui import ui
from starlette.responses import RedirectResponse

from pipeline.eigenheads.model_names import list_models
from pipeline.results.report import CameraReport, WarningReport
from rig.errors import InputError
from server.console.page import Action, Chosen, Page, remove_later, shared, show
from server.console.pages.rig import read_report
from server.console.removal import removals
from server.services.documents import JobLine
from server.services.jobs import FINISHED
from server.services.records import Job
from server.services.service import Service
from server.services.work import Work
from server.storage.events import JobEvent

SHOWN = 200
LOG_LINES = 200


class LogLine(TypedDict):
    """When a stage or state began, in seconds after the first event."""

    at_s: float
    text: str


class CameraLine(TypedDict):
    """What report.json says of a camera; None where it says nothing."""

    name: str
    view: bool | None
    used: bool | None
    iou: float | None
    contour_rms_px: float | None
    excluded_share: float | None
    xor_cost: float | None
    xor_cost_start: float | None


class JobDetail(TypedDict):
    """Of a job its log, and of a finished one residuals by camera, warnings and whether it has pictures."""

    id: str
    log: list[LogLine]
    cameras: list[CameraLine]
    warnings: list[WarningReport]
    seconds: dict[str, float]
    stopped_because: str | None
    evaluations: int | None
    pictures: bool


class ShownJob(JobLine):
    """A job in the list, with the label and time of its capture."""

    capture: str
    captured: str | None


class JobsState(TypedDict):
    jobs: list[ShownJob]
    models: list[str]


class JobsShown(JobsState):
    detail: JobDetail | None


class SettingsForm(TypedDict, total=False):
    """``more`` is further settings as JSON."""

    method: str
    detail: str
    front: str
    more: str | None


class RestartForm(Chosen, SettingsForm):
    model: NotRequired[str | None]


@dataclass(frozen=True, slots=True)
class ListedJob:
    """A job with the label, time and session of its capture."""

    job: Job
    capture: str
    captured: str | None
    session: str | None = None


class JobsPage(Page, component="jobs.js"):
    def look(self) -> JobsShown:
        state: JobsState = shared.get("jobs", 0.3, lambda: jobs_state(self.service))
        first = next((job for job in state["jobs"] if job["state"] == "running"), next(iter(state["jobs"]), None))
        chosen = self.choice.get("job") or (first["id"] if first else None)
        known = next((job["id"] for job in state["jobs"] if job["id"] == chosen), None)
        return {**state, "detail": None if known is None else job_detail(self.service, known)}


def jobs_state(service: Service) -> JobsState:
    jobs = [job_line(listed) for listed in jobs_list(service)]
    return {"jobs": jobs, "models": shared.get("models", 30.0, lambda: list(list_models()))}


def jobs_list(service: Service) -> list[ListedJob]:
    """Newest first."""
    found = []
    captures = {record.id: record for record in service.store.captures()}
    for job in service.jobs.find(limit=SHOWN):
        if job.id in removals:
            continue
        capture = captures.get(job.capture_id or "")
        if capture is None:
            found.append(ListedJob(job, "removed capture", None))
        else:
            found.append(ListedJob(job, capture.label, capture.created, capture.session))
    return found


def job_line(listed: ListedJob) -> ShownJob:
    job = {key: value for key, value in asdict(listed.job).items() if key != "files"}
    return cast(ShownJob, {**job, "capture": listed.capture, "captured": listed.captured})


def job_detail(service: Service, job_id: str) -> JobDetail:
    finished = service.jobs.state(job_id) in FINISHED

    def make() -> JobDetail:
        events = service.jobs.events.since(job_id, 0, limit=10_000)
        report = read_report(service, job_id) if finished else None
        cameras = {} if report is None else report.get("cameras", {})
        return {
            "id": job_id,
            "log": log_lines(events)[-LOG_LINES:],
            "cameras": [camera_line(name, camera) for name, camera in cameras.items()],
            "warnings": [] if report is None else report.get("warnings", []),
            "seconds": {} if report is None else report.get("seconds", {}),
            "stopped_because": None if report is None else report.get("stopped_because"),
            "evaluations": None if report is None else report.get("evaluations"),
            "pictures": report is not None,
        }

    return shared.get(("detail", job_id, finished), 3600.0 if finished else 0.4, make)


def camera_line(name: str, camera: CameraReport) -> CameraLine:
    view = camera.get("view")
    return {
        "name": name,
        "used": camera.get("used"),
        "iou": camera.get("iou"),
        "contour_rms_px": camera.get("contour_rms_px"),
        "excluded_share": camera.get("excluded_share"),
        "xor_cost": camera.get("xor_cost"),
        "xor_cost_start": camera.get("xor_cost_start"),
        "view": None if view is None else view.get("usable"),
    }


def log_lines(events: list[JobEvent]) -> list[LogLine]:
    """One line a stage or state: when it began, in seconds after the first event."""
    lines: list[LogLine] = []
    for event in events:
        text = event.document.get("stage") or event.document.get("state") or ""
        if not lines or lines[-1]["text"] != text:
            lines.append({"at_s": round(event.at - events[0].at, 1), "text": text})
    return lines


def restart(page: Page, event: RestartForm) -> str:
    wanted = Work(event.get("model") or None, chosen_settings(event))
    job = page.service.jobs.restart(event["id"], wanted, key=page.caller.key)
    page.choice["job"] = job.id
    return f"Queued job {job.id[-6:]}."


def chosen_settings(event: SettingsForm) -> Mapping[str, object]:
    """Settings from the form: method, detail and front, and further ones as JSON. Raises InputError."""
    try:
        settings = json.loads(event.get("more") or "{}")
    except ValueError as error:
        raise InputError("settings", [f"the further settings are no JSON ({error})"]) from error
    if not isinstance(settings, dict):
        raise InputError("settings", ['the further settings are no JSON object, such as {"fitting": {"modes": 80}}'])
    return settings | {key: event.get(key) for key in ("method", "detail", "front") if event.get(key)}


def cancel(page: Page, event: Chosen) -> None:
    page.service.cancel(event["id"])


def delete(page: Page, event: Chosen) -> None:
    service, identity = page.service, event["id"]
    service.jobs.get(identity)
    remove_later(identity, lambda: service.jobs.delete(identity), f"job {identity[-6:]}", "submit")


JobsPage.actions = {
    "restart": Action("submit", restart),
    "cancel": Action("submit", cancel),
    "delete": Action("submit", delete),
}


@ui.page("/jobs")
async def jobs_page(job: str = "") -> RedirectResponse | None:
    return await show("jobs", JobsPage, job=job or None)

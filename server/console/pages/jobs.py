"""Jobs: the queue, stage and progress, log, cancel, restart with other settings; what a finished one says of itself."""

import json
from typing import Any

from nicegui import ui
from starlette.responses import RedirectResponse

from pipeline.eigenheads.model_names import list_models
from rig.errors import InputError
from server.console.page import Action, Page, remove_later, shared, show
from server.console.pages.rig import read_report
from server.console.removal import removals
from server.services.jobs import FINISHED, Work
from server.services.service import Service

SHOWN = 200
LOG_LINES = 200


class JobsPage(Page, component="jobs.js"):
    def look(self) -> dict[str, Any]:
        state = shared.get("jobs", 0.3, lambda: jobs_state(self.service))
        chosen = self.choice.get("job") or (state["jobs"][0]["id"] if state["jobs"] else None)
        known = next((job["id"] for job in state["jobs"] if job["id"] == chosen), None)
        return state | {"detail": None if known is None else job_detail(self.service, known)}


def jobs_state(service: Service) -> dict[str, Any]:
    return {"jobs": jobs_list(service), "models": shared.get("models", 30.0, lambda: list(list_models()))}


def jobs_list(service: Service) -> list[dict[str, Any]]:
    """Newest first, each with the label and time of its capture."""
    found = []
    captures = {record["id"]: record for record in service.store.captures()}
    for job in service.jobs.find(limit=SHOWN):
        if job["id"] in removals:
            continue
        capture = captures.get(job["capture_id"], {"label": "removed capture", "created": None})
        named = {"capture": capture["label"], "captured": capture["created"]}
        found.append({key: value for key, value in job.items() if key != "files"} | named)
    return found


def job_detail(service: Service, job_id: str) -> dict[str, Any]:
    """The log of a job, and of a finished one residuals by camera, warnings and pictures."""
    finished = service.jobs.state(job_id) in FINISHED

    def make() -> dict[str, Any]:
        events = service.jobs.events.since(job_id, 0, limit=10_000)
        report = read_report(service, job_id) if finished else {}
        cameras = [
            {
                "name": name,
                **{key: camera.get(key) for key in FIGURES},
                "view": (camera.get("view") or {}).get("usable"),
            }
            for name, camera in report.get("cameras", {}).items()
        ]
        return {
            "id": job_id,
            "log": log_lines(events)[-LOG_LINES:],
            "cameras": cameras,
            "warnings": report.get("warnings", []),
            "seconds": report.get("seconds", {}),
            "stopped_because": report.get("stopped_because"),
            "evaluations": report.get("evaluations"),
            "pictures": bool(report),
        }

    return shared.get(("detail", job_id, finished), 3600.0 if finished else 0.4, make)


FIGURES = ("used", "iou", "contour_rms_px", "excluded_share", "xor_cost", "xor_cost_start")


def log_lines(events: list[Any]) -> list[dict[str, Any]]:
    """One line a stage or state: when it began, in seconds after the first event."""
    lines: list[dict[str, Any]] = []
    for event in events:
        text = event.document.get("stage") or event.document.get("state") or ""
        if not lines or lines[-1]["text"] != text:
            lines.append({"at_s": round(event.at - events[0].at, 1), "text": text})
    return lines


def restart(page: Page, event: dict[str, Any]) -> str:
    wanted = Work(event.get("model") or None, chosen_settings(event))
    job = page.service.jobs.restart(event["id"], wanted, key=page.caller.key)
    page.choice["job"] = job["id"]
    return f"Queued job {job['id'][-6:]}."


def chosen_settings(event: dict[str, Any]) -> dict[str, Any]:
    """Settings from the form: method, detail and front, and further ones as JSON. Raises InputError."""
    try:
        settings = json.loads(event.get("more") or "{}")
    except ValueError as error:
        raise InputError("settings", [f"the further settings are no JSON ({error})"]) from error
    if not isinstance(settings, dict):
        raise InputError("settings", ['the further settings are no JSON object, such as {"fitting": {"modes": 80}}'])
    return settings | {key: event[key] for key in ("method", "detail", "front") if event.get(key)}


def cancel(page: Page, event: dict[str, Any]) -> None:
    page.service.cancel(event["id"])


def delete(page: Page, event: dict[str, Any]) -> None:
    service, identity = page.service, event["id"]
    service.jobs.get(identity)
    remove_later(identity, lambda: service.jobs.delete(identity), f"job {identity[-6:]}", "submit")


JobsPage.actions = {
    "restart": Action("submit", restart),
    "cancel": Action("submit", cancel),
    "delete": Action("submit", delete),
}


@ui.page("/jobs")
async def jobs_page() -> RedirectResponse | None:
    return await show("jobs", JobsPage)

"""Captures: what there is, uploads, silhouettes over the images, jobs to start, removal with undo."""

from typing import Any

from fastapi import Response
from nicegui import ui
from starlette.responses import RedirectResponse

from pipeline.eigenheads.model import list_models
from server.console.page import Action, Page, remove_later, shared, show
from server.console.removal import removals
from server.problems import Problem
from server.routes.captures import delete_capture, edit_capture
from server.routes.jobs import submit_job, submit_session
from server.routes.sessions import edit_session, erase_session, make_session
from server.schemas import CaptureEdit, NewJob, NewSession, NewSessionJobs, SessionEdit
from server.service import Service

SHOWN = 500


class CapturesPage(Page, component="captures.js"):
    def look(self) -> dict[str, Any]:
        return shared.get("captures", 0.3, lambda: captures_state(self.service))


def captures_state(service: Service) -> dict[str, Any]:
    """Captures, newest first, with the newest job of each."""
    jobs: dict[str, dict[str, Any]] = {}
    for job in service.jobs.find(limit=SHOWN):
        jobs.setdefault(job["capture_id"], {"id": job["id"], "state": job["state"], "progress": job["progress"]})
    captures = []
    for record in service.store.captures():
        if record["id"] in removals:
            continue
        about = {key: record[key] for key in ("id", "created", "source", "label", "expression", "front", "features")}
        about |= {"cameras": [camera["name"] for camera in record["cameras"]], "bytes": record["bytes"]}
        about |= {"session": record["session"], "job": jobs.get(record["id"]), "board": record.get("board", False)}
        captures.append(about | {"size": record["cameras"][0]})
        if len(captures) == SHOWN:
            break
    return {
        "captures": captures,
        "sessions": sessions_list(service),
        "models": shared.get("models", 30.0, lambda: list(list_models())),
    }


def sessions_list(service: Service) -> list[dict[str, Any]]:
    """Newest first."""
    names = ("id", "created", "label", "consent")
    return [{name: record[name] for name in names} for record in service.store.sessions()]


def reconstruct(page: Page, event: dict[str, Any]) -> str:
    wanted = {"capture_id": event["id"], **chosen_work(event)}
    job = submit_job(page.service, page.caller, NewJob.model_validate(wanted), Response())
    return f"Queued job {job.id[-6:]}. Watch it on the page Jobs."


def reconstruct_session(page: Page, event: dict[str, Any]) -> str:
    wanted = NewSessionJobs.model_validate(chosen_work(event))
    jobs = submit_session(page.service, page.caller, event["id"], wanted).jobs
    return f"Queued {len(jobs)} {'job' if len(jobs) == 1 else 'jobs'}. Watch them on the page Jobs."


def chosen_work(event: dict[str, Any]) -> dict[str, Any]:
    """Model and solver of the form; what is not chosen is the service's default."""
    settings = {"method": event["method"]} if event.get("method") else {}
    return {"model": event.get("model") or None, "settings": settings}


def edit(page: Page, event: dict[str, Any]) -> None:
    given = {name: event[name] for name in ("label", "expression", "session") if name in event}
    edit_capture(page.service, page.caller, event["id"], CaptureEdit.model_validate(given))
    shared.forget("captures")


def new_session(page: Page, event: dict[str, Any]) -> str:
    wanted = NewSession(label=event.get("label", ""), consent=event.get("consent", ""))
    made = make_session(page.service, page.caller, wanted, Response())
    shared.forget("captures")
    return f"Session {made.label or made.id[-6:]}: what is taken or uploaded now belongs to it."


def edit_consent(page: Page, event: dict[str, Any]) -> None:
    given = {name: event[name] for name in ("label", "consent") if name in event}
    edit_session(page.service, page.caller, event["id"], SessionEdit.model_validate(given))
    shared.forget("captures")


def erase(page: Page, event: dict[str, Any]) -> str:
    erase_session(page.service, page.caller, event["id"])
    shared.clear()  # reports of its heads among them
    return "Erased: images, heads, jobs and all that was kept of them."


def remove(page: Page, event: dict[str, Any]) -> None:
    service, caller, identity = page.service, page.caller, event["id"]
    record = service.store.capture(identity)
    if active := service.jobs.active(capture=identity):
        detail = "Jobs that are queued or running need this capture; cancel them first."
        raise Problem(409, "capture-in-use", detail, [f"job {job}" for job in active])

    def delete() -> None:
        delete_capture(service, caller, identity)

    remove_later(identity, delete, f"capture {record['label'] or identity[-6:]}", "capture")


CapturesPage.actions = {
    "reconstruct": Action("submit", reconstruct),
    "reconstruct_session": Action("submit", reconstruct_session),
    "edit": Action("capture", edit),
    "new_session": Action("capture", new_session),
    "edit_session": Action("capture", edit_consent),
    "erase": Action("capture", erase),
    "remove": Action("capture", remove),
}


@ui.page("/captures")
async def captures_page() -> RedirectResponse | None:
    return await show("captures", CapturesPage)

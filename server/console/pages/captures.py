"""Captures: what there is, uploads, silhouettes over the images, jobs to start, removal with undo."""

from typing import Any

from fastapi import Response
from nicegui import ui
from starlette.responses import RedirectResponse

from server.console.page import Action, Page, shared, signed_in
from server.console.removal import Removals
from server.console.theme import page_frame
from server.problems import Problem
from server.routes.captures import delete_capture
from server.routes.jobs import submit_job
from server.schemas import NewJob
from server.service import Service

SHOWN = 500
removals = Removals()


class CapturesPage(Page, component="captures.js"):
    def look(self) -> dict[str, Any]:
        return shared.get("captures", 0.3, lambda: captures_state(self.service))


def captures_state(service: Service) -> dict[str, Any]:
    """Captures, newest first, with the newest job of each, and what waits to be removed."""
    waiting = removals.remaining_s()
    jobs: dict[str, dict[str, Any]] = {}
    for job in service.jobs.find(limit=SHOWN):
        jobs.setdefault(job["capture_id"], {"id": job["id"], "state": job["state"], "progress": job["progress"]})
    sessions = {record["id"]: record["label"] or record["id"][-6:] for record in service.store.sessions()}
    captures = []
    for record in service.store.captures():
        about = {key: record[key] for key in ("id", "created", "source", "label", "expression", "front", "features")}
        about |= {"cameras": [camera["name"] for camera in record["cameras"]], "bytes": record["bytes"]}
        about |= {"session": sessions.get(record["session"] or ""), "job": jobs.get(record["id"])}
        captures.append(about | {"size": record["cameras"][0], "removed": record["id"] in waiting})
        if len(captures) == SHOWN:
            break
    return {"captures": captures, "undo_s": removals.wait_s}


def reconstruct(page: Page, event: dict[str, Any]) -> str:
    job = submit_job(page.service, page.caller, NewJob.model_validate({"capture_id": event["id"]}), Response())
    return f"Queued job {job.id[-6:]}. Watch it on the page Jobs."


def remove(page: Page, event: dict[str, Any]) -> None:
    service, caller, identity = page.service, page.caller, event["id"]
    service.store.capture(identity)
    if active := service.jobs.active(capture=identity):
        detail = "Jobs that are queued or running need this capture; cancel them first."
        raise Problem(409, "capture-in-use", detail, [f"job {job}" for job in active])

    def delete() -> None:
        delete_capture(service, caller, identity)

    removals.add(identity, delete)
    shared.forget("captures")


def undo(page: Page, event: dict[str, Any]) -> str:
    shared.forget("captures")
    if not removals.undo(event["id"]):
        raise Problem(410, "too-late", "It is removed already. Upload or shoot it again.")
    return "The capture is back."


CapturesPage.actions = {
    "reconstruct": Action("submit", reconstruct),
    "remove": Action("capture", remove),
    "undo": Action("capture", undo),
}


@ui.page("/captures")
async def captures_page() -> RedirectResponse | None:
    caller = await signed_in()
    if caller is None:
        return RedirectResponse("/sign-in")
    with page_frame("captures") as frame:
        CapturesPage(frame, caller)
    return None

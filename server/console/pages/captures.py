"""Captures: what there is, uploads, silhouettes over the images, jobs to start, removal with undo."""

from typing import Any

from nicegui import ui
from starlette.responses import RedirectResponse

from pipeline.eigenheads.model_names import list_models
from rig.errors import InputError
from server.console.page import Action, Page, remove_later, shared, show
from server.console.removal import removals
from server.services.captures import TEXT_MOST, About
from server.services.jobs import Work
from server.services.service import Service

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
    job = page.service.jobs.submit(event["id"], chosen_work(event), key=page.caller.key)
    return f"Queued job {job['id'][-6:]}. Watch it on the page Jobs."


def reconstruct_session(page: Page, event: dict[str, Any]) -> str:
    work = chosen_work(event)
    jobs = page.service.jobs.submit_session(event["id"], work, key=page.caller.key, priority=100)
    return f"Queued {len(jobs)} {'job' if len(jobs) == 1 else 'jobs'}. Watch them on the page Jobs."


def chosen_work(event: dict[str, Any]) -> Work:
    """Model and solver of the form; what is not chosen is the service's default."""
    settings = {"method": event["method"]} if event.get("method") else {}
    return Work(event.get("model") or None, settings)


def edit(page: Page, event: dict[str, Any]) -> None:
    given = {name: event[name] for name in ("label", "expression", "session") if name in event}
    About.of({name: given[name] for name in given if name != "session"})
    page.service.captures.edit(event["id"], given)
    shared.forget("captures")


def new_session(page: Page, event: dict[str, Any]) -> str:
    made = page.service.sessions.add(*session_texts(event.get("label", ""), event.get("consent", "")))
    shared.forget("captures")
    return f"Session {made['label'] or made['id'][-6:]}: what is taken or uploaded now belongs to it."


def edit_consent(page: Page, event: dict[str, Any]) -> None:
    given = {name: str(event[name] or "") for name in ("label", "consent") if name in event}
    session_texts(*given.values())
    page.service.sessions.edit(event["id"], given)
    shared.forget("captures")


def erase(page: Page, event: dict[str, Any]) -> str:
    page.service.sessions.erase(event["id"])
    shared.clear()  # reports of its heads among them
    return "Erased: images, heads, jobs and all that was kept of them."


def remove(page: Page, event: dict[str, Any]) -> None:
    service, identity = page.service, event["id"]
    record = service.captures.check_unused(identity)
    title = f"capture {record['label'] or identity[-6:]}"
    remove_later(identity, lambda: service.captures.remove(identity), title, "capture")


def session_texts(*texts: str) -> tuple[str, ...]:
    """Raises InputError for texts that are too long."""
    if any(len(text) > TEXT_MOST for text in texts):
        raise InputError("form", [f"a text is longer than {TEXT_MOST} characters"])
    return texts


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

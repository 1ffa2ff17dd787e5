"""Captures: what there is, uploads, silhouettes over the images, jobs to start, removal with undo."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import NotRequired, TypedDict, cast

from nicegui import ui
from starlette.responses import RedirectResponse

from pipeline.eigenheads.model_names import list_models
from rig.acquisition.shot import CameraSyncDocument, FaultDocument, SyncDocument
from rig.errors import InputError
from server.console.page import Action, Chosen, Page, remove_later, shared, show
from server.console.removal import removals
from server.services.captures import TEXT_MOST, About
from server.services.service import Service
from server.services.work import Work
from server.storage.records import CaptureRecord
from server.tasks.simulate import SimulatedCertificate, SimulatedSync

SHOWN = 500


class LatestJob(TypedDict):
    id: str
    state: str
    progress: float


class SyncLine(TypedDict):
    """What the rig's certificate says, for people."""

    text: str
    good: bool


class CaptureLine(TypedDict):
    """A capture in the list; ``size`` is that of its first camera's pictures, ``job`` its newest."""

    id: str
    created: str
    source: str
    label: str
    expression: str
    front: str
    features: bool
    cameras: list[str]
    bytes: int
    session: str | None
    job: LatestJob | None
    board: bool
    size: dict[str, str | int]
    sizes: dict[str, tuple[int, int]]
    verdict: str | None
    faults: list[FaultDocument]
    sync: SyncLine | None


class SessionLine(TypedDict):
    id: str
    created: str
    label: str
    consent: str


class CapturesState(TypedDict):
    captures: list[CaptureLine]
    sessions: list[SessionLine]
    models: list[str]


class WorkForm(Chosen):
    model: NotRequired[str | None]
    method: NotRequired[str | None]


class EditForm(Chosen):
    label: NotRequired[str]
    expression: NotRequired[str]
    session: NotRequired[str | None]


class SessionForm(TypedDict):
    label: NotRequired[str]
    consent: NotRequired[str]


class SessionEditForm(Chosen, SessionForm):
    pass


class CapturesPage(Page, component="captures.js"):
    def look(self) -> CapturesState:
        return shared.get("captures", 0.3, lambda: captures_state(self.service))


def captures_state(service: Service) -> CapturesState:
    """Captures, newest first, with the newest job of each."""
    jobs: dict[str | None, LatestJob] = {}
    for job in service.jobs.find(limit=SHOWN):
        jobs.setdefault(job.capture_id, {"id": job.id, "state": job.state, "progress": job.progress})
    captures: list[CaptureLine] = []
    for record in service.store.captures():
        if record.id in removals:
            continue
        captures.append(capture_line(record, jobs.get(record.id)))
        if len(captures) == SHOWN:
            break
    return {
        "captures": captures,
        "sessions": sessions_list(service),
        "models": shared.get("models", 30.0, lambda: list(list_models())),
    }


def capture_line(record: CaptureRecord, job: LatestJob | None) -> CaptureLine:
    return {
        "id": record.id,
        "created": record.created,
        "source": record.source,
        "label": record.label,
        "expression": record.expression,
        "front": record.front,
        "features": record.features,
        "cameras": [camera.name for camera in record.cameras],
        "bytes": record.bytes,
        "session": record.session,
        "job": job,
        "board": record.board,
        "size": asdict(record.cameras[0]),
        "sizes": {camera.name: (camera.width, camera.height) for camera in record.cameras},
        "verdict": record.verdict,
        "faults": [fault.document() for fault in record.faults],
        "sync": None if record.shot is None else sync_line(record.shot),
    }


def sync_line(shot: Mapping[str, object]) -> SyncLine:
    """How far the pictures of a shot belong to one moment."""
    lines = sync_of(shot)
    late = sorted(name for name, line in lines.items() if line["status"] not in ("in sync", "recorded"))
    if late:
        return {"text": f"not in sync: {', '.join(late)}", "good": False}
    spread_ms = cast(SyncDocument, shot["sync"])["spread_ms"] if "sync" in shot else None
    within = "" if spread_ms is None else f", within {spread_ms:.1f} ms"
    return {"text": f"{len(lines)} cameras in sync{within}", "good": True}


def sync_of(shot: Mapping[str, object]) -> Mapping[str, CameraSyncDocument | SimulatedSync]:
    """Status and skew of each camera in a capture's certificate, of a real rig or of the simulated studio."""
    certificate = cast(SyncDocument | SimulatedCertificate, shot.get("sync", shot))
    return certificate.get("cameras", {})


def sessions_list(service: Service) -> list[SessionLine]:
    """Newest first."""
    return [
        {"id": record.id, "created": record.created, "label": record.label, "consent": record.consent}
        for record in service.store.sessions()
    ]


def reconstruct(page: Page, event: WorkForm) -> str:
    job = page.service.jobs.submit(event["id"], chosen_work(event), key=page.caller.key)
    return f"Queued job {job.id[-6:]}. Watch it on the page Jobs."


def reconstruct_session(page: Page, event: WorkForm) -> str:
    work = chosen_work(event)
    jobs = page.service.jobs.submit_session(event["id"], work, key=page.caller.key, priority=100)
    return f"Queued {len(jobs)} {'job' if len(jobs) == 1 else 'jobs'}. Watch them on the page Jobs."


def chosen_work(event: WorkForm) -> Work:
    """Model and solver of the form; what is not chosen is the service's default."""
    method = event.get("method")
    settings = {"method": method} if method else {}
    return Work(event.get("model") or None, settings)


def edit(page: Page, event: EditForm) -> None:
    given: dict[str, str | None] = {k: event.get(k) for k in ("label", "expression", "session") if k in event}
    About.of({name: given[name] for name in given if name != "session"})
    page.service.captures.edit(event["id"], given)
    shared.forget("captures")


def new_session(page: Page, event: SessionForm) -> str:
    made = page.service.sessions.add(*session_texts(event.get("label", ""), event.get("consent", "")))
    shared.forget("captures")
    return f"Session {made.label or made.id[-6:]}: what is taken or uploaded now belongs to it."


def edit_consent(page: Page, event: SessionEditForm) -> None:
    given = {name: str(event.get(name) or "") for name in ("label", "consent") if name in event}
    session_texts(*given.values())
    page.service.sessions.edit(event["id"], label=given.get("label"), consent=given.get("consent"))
    shared.forget("captures")


def erase(page: Page, event: Chosen) -> str:
    page.service.sessions.erase(event["id"])
    shared.clear()  # reports of its heads among them
    return "Erased: images, heads, jobs and all that was kept of them."


def erase_capture(page: Page, event: Chosen) -> str:
    page.service.captures.erase(event["id"])
    shared.clear()
    return "Erased for good: the capture, its heads, jobs and all that was kept of them."


def discard(page: Page, event: Chosen) -> None:
    service, identity = page.service, event["id"]
    record = service.captures.check_unused(identity)
    heads = len(service.captures.holdings(identity).heads)
    stays = f"; {heads} {'head' if heads == 1 else 'heads'} with overlay photographs stay" if heads else ""
    title = f"the {len(record.cameras)} pictures of capture {record.label or identity[-6:]}{stays}"
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
    "erase_capture": Action("capture", erase_capture),
    "remove": Action("capture", discard),
}


@ui.page("/captures")
async def captures_page() -> RedirectResponse | None:
    return await show("captures", CapturesPage)

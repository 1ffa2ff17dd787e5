"""Implements the page Captures: the list, uploads, outlines over the images, starting jobs, and removal with undo.

The module converts the values of the page's form to a job request. A preset is a named choice of a job's settings; for
other settings the user writes a settings document."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import cast, get_args

from pipeline.head_model.model_names import list_models
from pipeline.settings import settings_from_document
from rig.messages.message import Message, compose, documents_of
from server.console.identity import permit
from server.console.page import Action, Page, remove_all_later, remove_later, said_unless_refused, serve_page, shared
from server.console.removal import removals
from server.errors import NotFound
from server.services.bulk import apply_each
from server.services.records import SessionOut
from server.services.service import Service
from server.services.templates import templates_at_hand
from server.services.texts import typed_tags
from server.services.work import ReconstructionRequest
from server.storage.library import CaptureOrder, CaptureQuery
from server.storage.records import CaptureRecord, JsonObject

SHOWN = 50  # captures of a page
ASKED = ("find", "session", "verdict", "tag", "sort", "after", "capture")
OF_RECORD = (
    *("id", "created", "source", "label", "expression", "front"),
    *("features", "bytes", "session", "kind", "frames", "verdict"),
)
SESSIONS_SHOWN = 200  # newest ones, in lists to choose from; older ones are found on the page Subjects


def jobs_of(service: Service, captures: Sequence[str]) -> dict[str, list[JsonObject]]:
    """Returns the jobs of each capture, newest first, with the progress (0 to 1) of running jobs. Jobs that are being
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
    ``size``: size of the first camera's pictures (px); ``sizes``: width and height by camera."""
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
    """Writes a sentence on the time differences of a shot's pictures, with ``good`` if the differences are small.
    ``shot`` is its certificate."""
    lines = sync_of(shot)
    late = sorted(name for name, line in lines.items() if line["status"] not in ("in sync", "recorded"))
    if late:
        return {"message": compose("not-in-sync", cameras=late).document(), "good": False}
    spread_ms = cast(JsonObject, shot["sync"])["spread_ms"] if "sync" in shot else None
    if spread_ms is None:
        return {"message": compose("cameras-in-sync", count=len(lines)).document(), "good": True}
    within = compose("cameras-in-sync-within", count=len(lines), spread_ms=spread_ms)
    return {"message": within.document(), "good": True}


def sync_of(shot: Mapping[str, object]) -> JsonObject:
    """Returns the sync status and skew of each camera from the certificate of a shot, of a real rig or of the simulated
    studio."""
    return cast(JsonObject, shot.get("sync", shot)).get("cameras", {})


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
    """Converts a session to an entry of a list. ``captures`` counts the captures that are not being removed."""
    return session.model_dump() | {"captures": sum(capture not in removals for capture in session.captures)}


@dataclass(frozen=True, slots=True)
class Preset:
    """Holds a preset: its title and explanation for people, and the settings document that it stands for. Raises
    InputError for wrong settings."""

    id: str
    title: Message
    explanation: Message
    settings: Mapping[str, object]

    def __post_init__(self) -> None:
        settings_from_document(self.settings)


PRESETS = (
    Preset("", compose("preset-standard"), compose("preset-standard-explained"), {}),
    Preset(
        "quick",
        compose("preset-quick"),
        compose("preset-quick-explained"),
        {"detail": "span", "outputs": {"surface": "head"}},
    ),
    Preset("head", compose("preset-head"), compose("preset-head-explained"), {"outputs": {"surface": "head"}}),
    Preset(
        "texture",
        compose("preset-renderers"),
        compose("preset-renderers-explained"),
        {"outputs": {"formats": ["glb", "ply", "obj", "usdz"]}},
    ),
    Preset("simplex", compose("preset-paper"), compose("preset-paper-explained"), {"method": "simplex"}),
)


def settings_of(preset: str | None) -> Mapping[str, object]:
    """Returns the settings of the preset with this id. None or an unknown ``preset`` selects the preset Standard."""
    return next((known.settings for known in PRESETS if known.id == (preset or "")), {})


def preset_lines() -> list[JsonObject]:
    """Converts all presets to entries of a form's list."""
    return [{"id": p.id, "title": p.title.document(), "explanation": p.explanation.document()} for p in PRESETS]


def template_lines() -> list[JsonObject]:
    """Converts the templates whose model is installed to entries of a form's list."""
    return [
        {"name": template.name, "models": list(template.models)} for template in templates_at_hand() if template.models
    ]


def chosen_work(event: JsonObject) -> ReconstructionRequest:
    """Returns the request that a form describes: model, preset (``method``) and template. Values that the form leaves
    out get the service's default values."""
    settings, template = dict(settings_of(event.get("method"))), event.get("template")
    if template:
        settings["outputs"] = cast(dict[str, object], settings.get("outputs", {})) | {"template": template}
    return ReconstructionRequest(event.get("model") or None, settings)


class CapturesPage(Page, component="captures.js"):
    """Shows the list of captures, and the selected one with its pictures, outlines and jobs."""

    def look(self) -> JsonObject:
        """Returns the state of the page. The selection stays when other captures arrive, so the operator always removes
        the capture that is shown."""
        requested = {name: self.choice.get(name) or None for name in ASKED}
        state: JsonObject = shared.get(
            ("captures", *requested.values()), 0.3, lambda: captures_state(self.service, requested)
        )
        if state["chosen"] is not None and (self.choice.get("capture") or None) == requested["capture"]:
            self.choice["capture"] = state["chosen"]["id"]
        return state


def captures_state(service: Service, requested: Mapping[str, str | None]) -> JsonObject:
    """Returns one page of the captures that match the request, each with its jobs. Captures that are being removed are
    left out. ``chosen``: the selected capture, even if it is on another page of the list."""
    order = cast(CaptureOrder, requested["sort"] if requested["sort"] in get_args(CaptureOrder) else "-created")
    query = CaptureQuery(
        requested["find"] or "", requested["session"], requested["verdict"], tag=requested["tag"], order=order
    )
    matching = service.captures.page(query, SHOWN, requested["after"])
    records = [record for record in matching.items if record.id not in removals]
    chosen = [record for record in service.captures.of([requested["capture"] or ""]) if record.id not in removals]
    jobs = jobs_of(service, [record.id for record in (*records, *chosen)])
    lines = [capture_line(record, jobs[record.id]) for record in records]
    return {
        "captures": lines,
        "chosen": capture_line(chosen[0], jobs[chosen[0].id]) if chosen else next(iter(lines), None),
        "next": matching.next,
        "total": matching.total - (len(matching.items) - len(records)),
        "sessions": sessions_list(service, requested["session"]),
        "tags": shared.get("tags", 1.0, service.captures.tags),
        "models": shared.get("models", 30.0, lambda: list(list_models())),
        "presets": preset_lines(),
        "templates": shared.get("templates", 5.0, template_lines),
    }


def reconstruct(page: Page, event: JsonObject) -> Message:
    """Queues a job for a capture; the page shows a shot's head when it is ready. Raises what ``Jobs.submit`` raises."""
    job = page.service.jobs.submit(event["id"], chosen_work(event), key=page.caller.key)
    page.started(job.id, opens=job.frames is None)
    return compose("job-queued-watch", job=job.id[-6:])


def reconstruct_session(page: Page, event: JsonObject) -> Message:
    """Queues a job for every capture of a session that shows a head. Raises what ``Jobs.submit_session`` raises."""
    work = chosen_work(event)
    jobs = page.service.jobs.submit_session(event["id"], work, key=page.caller.key, priority=100)
    page.started(*(job.id for job in jobs))
    return compose("jobs-queued", count=len(jobs))


def sample(page: Page, event: object) -> Message:
    """Takes a capture of the simulated studio and selects it, for people who have no pictures yet."""
    record = page.service.captures.sample()
    page.choice["capture"] = record.id
    forget_captures()
    return compose("sample-taken")


def edit(page: Page, event: JsonObject) -> None:
    """Changes label, expression, session or tags (separated by commas) of a capture; fields that the form does not
    contain keep their values. Raises NotFound and InputError."""
    changes: dict[str, str | None] = {k: event.get(k) for k in ("label", "expression", "session") if k in event}
    tags = typed_tags(event["tags"]) if "tags" in event else None
    page.service.captures.edit(event["id"], changes, tags=tags)
    forget_captures()


def new_session(page: Page, event: JsonObject) -> Message:
    """Makes a session. Raises InputError if its label or consent note is invalid."""
    session = page.service.sessions.add(event.get("label", ""), event.get("consent", ""))
    forget_captures()
    return compose("session-begun", name=session.label or session.id[-6:])


def edit_consent(page: Page, event: JsonObject) -> None:
    """Changes the label or the consent note of a session. Raises NotFound and InputError."""
    changes = {name: str(event.get(name) or "") for name in ("label", "consent") if name in event}
    page.service.sessions.edit(event["id"], label=changes.get("label"), consent=changes.get("consent"))
    forget_captures()


def erase(page: Page, event: JsonObject) -> Message:
    """Erases a session for good, without undo, as ``Sessions.erase`` does. Raises NotFound and Unavailable."""
    page.service.sessions.erase(event["id"])
    shared.clear()  # reports of its heads among them
    return compose("session-erased")


def erase_capture(page: Page, event: JsonObject) -> Message:
    """Erases a capture for good, without undo, as ``Captures.erase`` does. Raises NotFound and Unavailable."""
    page.service.captures.erase(event["id"])
    shared.clear()
    return compose("capture-erased")


def discard(page: Page, event: JsonObject) -> None:
    """Removes a capture after the time to undo has passed; a message states how many heads stay. Raises NotFound, and
    Conflict while a queued or running job needs the capture."""
    service, identity = page.service, event["id"]
    record = service.captures.check_unused(identity)
    held = service.captures.holdings(identity)
    title = compose("capture-pictures", pictures=held.pictures, name=record.label or identity[-6:])
    if held.heads:
        title = compose("heads-stay", thing=title, count=len(held.heads))
    remove_later(identity, lambda: service.captures.remove(identity), title, "capture")


def bulk(page: Page, event: JsonObject) -> Message | None:
    """Applies one ``action`` to all ticked captures, ``ids``. ``id``: the session to move the captures to, or empty. An
    action that is refused for some captures is applied to the others, and raises InvalidInput with the reasons."""
    service, ids, action = page.service, event["ids"], event["action"]
    if action == "reconstruct":
        permit(page.caller, "submit")
        work = chosen_work(event)
        jobs: list[str] = []
        done = apply_each(ids, lambda capture: jobs.append(service.jobs.submit(capture, work, key=page.caller.key).id))
        page.started(*jobs)
    elif action == "move":
        done = apply_each(ids, lambda capture: service.captures.edit(capture, {"session": event["id"] or None}))
    elif action in ("tag", "untag"):
        tags, change = typed_tags(event.get("tags", "")), service.captures.tag
        if action == "untag":
            change = service.captures.untag
        done = apply_each(ids, lambda capture: change(capture, tags))
    elif action == "erase":
        permit(page.caller, "erase")
        done = apply_each(ids, service.captures.erase)
    else:
        done = apply_each(ids, service.captures.check_unused)
        heads = sum(len(service.captures.holdings(capture).heads) for capture in done.done)
        title = compose("captures-pictures", count=len(done.done))
        if heads:
            title = compose("heads-stay", thing=title, count=heads)
        if done.done:
            remove_all_later(done.done, service.captures.remove, title, "capture")
    forget_captures()
    return said_unless_refused(said_of(action, len(done.done)), done)


def said_of(action: str, count: int) -> Message:
    """Returns the message that ``action`` was applied to ``count`` captures."""
    said = {
        "reconstruct": compose("captures-queued", count=count),
        "move": compose("captures-moved", count=count),
        "tag": compose("captures-tagged", count=count),
        "untag": compose("captures-untagged", count=count),
        "erase": compose("captures-erased", count=count),
    }
    return said.get(action) or compose("captures-removed", count=count)


def forget_captures() -> None:
    """Drops the cached values about captures, sessions, tags and subjects."""
    shared.forget("captures", "sessions", "tags", "subjects", "rig")


CapturesPage.actions = {
    "reconstruct": Action("submit", reconstruct),
    "reconstruct_session": Action("submit", reconstruct_session),
    "edit": Action("capture", edit),
    "new_session": Action("capture", new_session),
    "edit_session": Action("capture", edit_consent),
    "erase": Action("erase", erase),
    "erase_capture": Action("erase", erase_capture),
    "remove": Action("capture", discard),
    "bulk": Action("capture", bulk),
    "sample": Action("capture", sample),
}


serve_page(
    "captures", CapturesPage, choices=("capture", "find", "session", "verdict", "tag", "sort"), paths=("/captures",)
)

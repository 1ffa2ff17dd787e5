"""Implements the page Captures: the list, uploads, outlines over the images, jobs to start, and removal with undo."""

from collections.abc import Mapping
from typing import NotRequired, TypedDict, cast, get_args

from pipeline.head_model.model_names import list_models
from rig.messages.message import Message, compose
from server.console.capture_lines import capture_line, jobs_of, sessions_list
from server.console.identity import permit
from server.console.page import (
    Action,
    Chosen,
    Page,
    remove_all_later,
    remove_later,
    said_unless_refused,
    serve_page,
    shared,
)
from server.console.removal import removals
from server.console.work_form import WorkForm, chosen_work, preset_lines, template_lines
from server.services.bulk import each
from server.services.service import Service
from server.services.texts import typed_tags
from server.storage.library import CaptureOrder, CaptureQuery
from server.storage.records import JsonObject

SHOWN = 50  # captures of a page
ASKED = ("find", "session", "verdict", "tag", "sort", "after", "capture")


class EditForm(Chosen):
    """Holds changes to a capture. Fields that are left out keep their values; ``tags`` are separated by commas."""

    label: NotRequired[str]
    expression: NotRequired[str]
    session: NotRequired[str | None]
    tags: NotRequired[str]


class SessionForm(TypedDict):
    """Holds the label and the consent note of a session."""

    label: NotRequired[str]
    consent: NotRequired[str]


class SessionEditForm(Chosen, SessionForm):
    """Holds changes to a session. Fields that are left out keep their values."""


class BulkForm(WorkForm):
    """Holds one action on all captures ``ids``. ``id``: the session to move them to, empty for none; ``tags``:
    separated by commas."""

    ids: list[str]
    action: str
    tags: NotRequired[str]


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
    """Returns one page of the captures that match what is requested, each with its jobs. Captures that are being
    removed are left out. ``chosen``: the selected capture, even if it is on another page of the list."""
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


def reconstruct(page: Page, event: WorkForm) -> Message:
    """Queues a job for a capture; its head opens when it is ready. Raises what ``Jobs.submit`` raises."""
    job = page.service.jobs.submit(event["id"], chosen_work(event), key=page.caller.key)
    page.started(job.id, opens=True)
    return compose("job-queued-watch", job=job.id[-6:])


def reconstruct_session(page: Page, event: WorkForm) -> Message:
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


def edit(page: Page, event: EditForm) -> None:
    """Changes label, expression, session or tags of a capture. Raises NotFound and InputError."""
    changes: dict[str, str | None] = {k: event.get(k) for k in ("label", "expression", "session") if k in event}
    tags = typed_tags(event["tags"]) if "tags" in event else None
    page.service.captures.edit(event["id"], changes, tags=tags)
    forget_captures()


def new_session(page: Page, event: SessionForm) -> Message:
    """Makes a session. Raises InputError for invalid texts."""
    session = page.service.sessions.add(event.get("label", ""), event.get("consent", ""))
    forget_captures()
    return compose("session-begun", name=session.label or session.id[-6:])


def edit_consent(page: Page, event: SessionEditForm) -> None:
    """Changes the label or the consent note of a session. Raises NotFound and InputError."""
    changes = {name: str(event.get(name) or "") for name in ("label", "consent") if name in event}
    page.service.sessions.edit(event["id"], label=changes.get("label"), consent=changes.get("consent"))
    forget_captures()


def erase(page: Page, event: Chosen) -> Message:
    """Erases a session permanently, without undo, as ``Sessions.erase`` does. Raises NotFound and Unavailable."""
    page.service.sessions.erase(event["id"])
    shared.clear()  # reports of its heads among them
    return compose("session-erased")


def erase_capture(page: Page, event: Chosen) -> Message:
    """Erases a capture permanently, without undo, as ``Captures.erase`` does. Raises NotFound and Unavailable."""
    page.service.captures.erase(event["id"])
    shared.clear()
    return compose("capture-erased")


def discard(page: Page, event: Chosen) -> None:
    """Removes a capture after the time to undo that has passed; the message states how many heads stay. Raises
    NotFound, and Conflict while a queued or running job needs it."""
    service, identity = page.service, event["id"]
    record = service.captures.check_unused(identity)
    heads = len(service.captures.holdings(identity).heads)
    title = compose("capture-pictures", pictures=len(record.cameras), name=record.label or identity[-6:])
    if heads:
        title = compose("heads-stay", thing=title, count=heads)
    remove_later(identity, lambda: service.captures.remove(identity), title, "capture")


def bulk(page: Page, event: BulkForm) -> Message | None:
    """Applies one action to all ticked captures. If some refuse it, it is still applied to the others, and InvalidInput
    is raised with the reasons."""
    service, ids, action = page.service, event["ids"], event["action"]
    if action == "reconstruct":
        permit(page.caller, "submit")
        work = chosen_work(event)
        jobs: list[str] = []
        done = each(ids, lambda capture: jobs.append(service.jobs.submit(capture, work, key=page.caller.key).id))
        page.started(*jobs)
    elif action == "move":
        done = each(ids, lambda capture: service.captures.edit(capture, {"session": event["id"] or None}))
    elif action in ("tag", "untag"):
        tags, change = typed_tags(event.get("tags", "")), service.captures.tag
        if action == "untag":
            change = service.captures.untag
        done = each(ids, lambda capture: change(capture, tags))
    elif action == "erase":
        permit(page.caller, "erase")
        done = each(ids, service.captures.erase)
    else:
        done = each(ids, service.captures.check_unused)
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
    """Drops the cached lists that show captures, sessions, tags or subjects."""
    shared.forget("captures", "sessions", "tags", "subjects")


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

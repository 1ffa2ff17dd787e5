"""Provides for all pages: a component that shows a state document, actions that run in threads, cached values, and
shorter texts of refusals."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from threading import Lock
from typing import Any

import anyio
import anyio.to_thread
import structlog
from nicegui import app as pages
from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments
from starlette.requests import Request
from starlette.responses import RedirectResponse

from rig.errors import InputError
from rig.messages.message import Message, compose
from server.console.head_pictures import draw_first_view, warm_up
from server.console.identity import caller_of, permit, service_of_pages
from server.console.removal import removals
from server.console.theme import Frame, page_frame
from server.errors import Gone, InvalidInput
from server.problem_types import type_of_failure
from server.services.bulk import BulkOut, apply_each
from server.services.health import readiness
from server.services.keys import Caller
from server.services.records import JobError
from server.services.service import Service
from server.storage.records import JsonObject
from server.tasks.child import WorkFailed
from server.wire.problems import Problem, problem_from

REFRESH_S = 0.5
STATUS_S = 2.0
FOLLOW_S = 0.15  # how often a job that was started on a page is looked at: its head opens there as soon as it is done
FIRST_LOOK_S = 1.0  # so long a page waits to be sent with its state in it, which saves it a turn over the socket
FOLLOWED_MOST = 50
CROSSING = {"image": "", "fetch": "crossorigin"}  # the mode in which scripts ask, else the browser fetches twice
KEEP_S = 3600.0  # of a value that is shared by all pages
KEEP_TIMES = 9.0  # a value is kept so many times as long as it took to make,
KEEP_MOST_S = 5.0  # but no longer: the one look that waited for a locked database would stand for minutes
MAKE = Callable[[], Any]

log = structlog.get_logger()

_threads = anyio.CapacityLimiter(16)  # actions and looks of all pages; a capture holds one for seconds


@dataclass(frozen=True, slots=True)
class Action:
    """Describes the action that an event of a page runs. ``function(page, event)`` runs in a thread, for callers with
    ``scope``. ``page`` is the page on which the event happened, and ``event`` is what the page's component sent: an
    ``id``, or the fields of a form.

    A message that the action's function returns, or an error with its faults, is shown in the page's corner.
    """

    scope: str
    function: Callable[[Any, Any], Message | None]


@dataclass
class Cache:
    """Caches values that all open pages show, so that the pages agree and ten pages cost no more than one page.

    A value is kept at least ``KEEP_TIMES`` times its computing time, up to ``KEEP_MOST_S`` seconds, so that computing
    takes at most a tenth of the time.
    """

    _values: dict[Any, tuple[float, float, Any]] = field(default_factory=dict)
    _locks: dict[Any, Lock] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)
    _forgets: int = 0

    def get(self, key: Any, age_s: float, make: MAKE) -> Any:
        """Returns the value of ``key``. If the value is older than ``age_s`` seconds, ``make`` computes it anew, in one
        thread at a time. Blocks. Raises what ``make`` raises."""
        with self._lock:
            key_lock = self._locks.setdefault(key, Lock())
        with key_lock:
            made_s, took, value = self._values.get(key, (0.0, 0.0, None))
            began = time.monotonic()
            if began - made_s > max(age_s, min(KEEP_TIMES * took, KEEP_MOST_S)) or key not in self._values:
                forgets = self._forgets
                value = make()
                if forgets == self._forgets:  # else something changed meanwhile, which the value may not show
                    self._values[key] = (time.monotonic(), time.monotonic() - began, value)
                self._drop_old()
            return value

    def forget(self, *kinds: str) -> None:
        """Drops the values whose key is one of ``kinds``, or is a tuple that begins with one. Values that are being
        computed at that time are not cached."""
        self._forgets += 1
        for key in list(self._values):
            if (key[0] if isinstance(key, tuple) else key) in kinds:
                self._values.pop(key, None)

    def _drop_old(self) -> None:
        """Drops values that no page has requested lately, mostly reports of jobs."""
        with self._lock:
            before = time.monotonic() - KEEP_S
            for key in [key for key, (made_s, _, _) in self._values.items() if made_s < before]:
                self._values.pop(key, None)
                self._locks.pop(key, None)

    def clear(self) -> None:
        """Drops all values, so that each page reads the values anew at its next refresh."""
        with self._lock:
            self._forgets += 1
            self._values.clear()
            self._locks.clear()


shared = Cache()


class Page(Element):
    """Shows one page: a Vue component with the property ``state``. The component's event ``act`` carries {name, ...}
    and runs the action of that name."""

    actions: Mapping[str, Action] = {}

    def __init__(self, frame: Frame, caller: Caller, **initial: str | None) -> None:
        super().__init__()
        self.frame, self.caller, self.service = frame, caller, service_of_pages()
        self.choice = initial
        self.props["state"] = {"loading": True}
        self._in_turn, self._looking = anyio.Lock(), anyio.Lock()
        self._told: Message | None = None
        self._started: tuple[list[str], bool] = ([], False)
        self._followed: list[str] = []
        self.on("act", self._act)
        self.on("choose", self._choose)
        frame.on("undo", self._undo)
        frame.on("follow", self._follow)

    def begin(self) -> None:
        """Starts to refresh the page's state, the status and the followed jobs regularly.

        NiceGUI sends a page when its first timer waits for the browser's connection, so timers start after the first
        refresh, and the state is sent with the page.
        """
        ui.timer(REFRESH_S, self.refresh, immediate="loading" in self.props["state"])
        ui.timer(STATUS_S, self._refresh_status, immediate=True)
        self._following = ui.timer(FOLLOW_S, self._refresh_followed, active=False, immediate=True)

    def look(self) -> Mapping[str, object]:
        """Returns the document that the page shows, of JSON values. The method runs in a thread and may block."""
        raise NotImplementedError

    def preloads(self) -> Iterable[tuple[str, str]]:
        """Returns what the browser should fetch while it still reads the page, as pairs of kind (``image``, ``fetch``)
        and address."""
        return ()

    async def refresh(self) -> None:
        """Reads the state of the page and sends it to the browser if it differs from the last one. If reading fails,
        the error is shown once, and the page keeps its last state."""
        try:
            async with self._looking:  # what was read before a choice must not be shown after it
                state = await anyio.to_thread.run_sync(self.look, limiter=_threads, abandon_on_cancel=True)
            detail = None
        except Exception as error:  # the page stays, says so once, and looks again
            problem = problem_from(error)
            state, detail = self.props["state"], problem.detail
            if detail != self._told:
                self.frame.say("fault", detail, problem.errors)
        self._told = detail
        waiting = removals.waiting().items()
        self.frame.show(removed=[{"id": i, "title": removal.title.document()} for i, removal in waiting])
        if state != self.props["state"]:
            self.props["state"] = state
            self.update()

    async def _refresh_status(self) -> None:
        caller = self.caller
        status = await anyio.to_thread.run_sync(status_of, self.service, caller, limiter=_threads)
        if status is None:
            if caller is self.caller:  # else its first key was made on this page meanwhile
                ui.navigate.to("/sign-in")
        else:
            self.frame.show(status=status)

    def started(self, *jobs: str, opens: bool = False) -> None:
        """Records jobs that an action has queued, so that this tab of the browser follows them. ``opens``: whether the
        job's head is shown when it is ready."""
        self._started = ([*jobs], opens)

    async def _follow(self, event: GenericEventArguments) -> None:
        self._followed = [str(job) for job in event.args][:FOLLOWED_MOST]
        self._following.active = bool(self._followed)
        if self._followed:
            await anyio.to_thread.run_sync(warm_up, limiter=_threads)

    async def _refresh_followed(self) -> None:
        ids = tuple(self._followed)
        jobs = await anyio.to_thread.run_sync(followed_jobs, self.service, ids, limiter=_threads)
        self.frame.show(followed=jobs)
        for job in jobs:
            if job["state"] == "succeeded":  # the page goes there now
                await anyio.to_thread.run_sync(draw_first_view, self.service, job["id"], limiter=_threads)

    async def _choose(self, event: GenericEventArguments) -> None:
        self.choice |= event.args
        await self.refresh()

    async def _undo(self, event: GenericEventArguments) -> None:
        await self._do("undo", {"id": event.args})

    async def _act(self, event: GenericEventArguments) -> None:
        async with self._in_turn:  # two quick keys must not overtake each other in the threads
            arguments = dict(event.args)
            await self._do(arguments.pop("name"), arguments)

    async def _do(self, name: str, event: Mapping[str, object]) -> None:
        done, self._started = False, ([], False)
        try:
            action = UNDO if name == "undo" else self.actions[name]
            said = await anyio.to_thread.run_sync(self._run, action, event, limiter=_threads)
            if said:
                self.frame.say("done", said)
            done = True
        except Exception as error:
            problem = as_problem(error)
            self.frame.say("fault", problem.detail, problem.errors)
        if self._started[0]:
            self.frame.run_method("began", *self._started)
        await self.refresh()
        self.run_method("acted", name, done)  # a form that was refused keeps what was typed

    def _run(self, action: Action, event: Mapping[str, object]) -> Message | None:
        current = caller_of(self.service, {"key_id": self.caller.key})
        permit(current, action.scope)
        return action.function(self, event)


def undo(page: Page, event: JsonObject) -> Message:
    """Undoes a removal that has not been carried out yet, whichever page began it. Raises Gone if the object was
    already removed, and Forbidden for a caller who could not have removed the object."""
    removal = removals.waiting().get(event["id"])
    if removal is not None:
        permit(page.caller, removal.scope)
    if removal is None or not removals.undo(event["id"]):
        raise Gone("too-late", compose("removed-already"))
    shared.clear()
    return compose("taken-back", thing=removal.title)


UNDO = Action("read", undo)


def remove_later(identity: str, remove: Callable[[], None], title: Message, scope: str) -> None:
    """Hides an object from all pages at once, and calls ``remove`` after ``UNDO_S`` seconds unless a user undoes the
    removal."""
    removals.add(identity, remove, title, scope)
    shared.clear()


def remove_all_later(ids: Sequence[str], remove: Callable[[str], None], title: Message, scope: str) -> None:
    """Hides several objects from all pages at once, and removes each object after ``UNDO_S`` seconds unless a user
    undoes the whole removal. Objects whose removal fails after the time to undo are logged."""

    def remove_each() -> None:
        done = apply_each(ids, remove)
        for one in done.refused:
            log.warning("not removed", id=one.id, error=one.detail.text)

    removals.add(f"{ids[0]} and all", remove_each, title, scope, also=ids)
    shared.clear()


def said_unless_refused(said: Message, done: BulkOut) -> Message:
    """Returns the message about an action on many objects. Raises InvalidInput if some objects were refused."""
    if done.refused:
        faults = [compose("located", where=one.id[-6:], fault=one.detail) for one in done.refused]
        raise InvalidInput("some-refused", compose("some-refused", done=said, refused=len(faults)), faults)
    return said


def as_problem(error: Exception) -> Problem:
    """Converts an error to the problem that a page shows. An InputError with a single fault is shown as that fault
    alone."""
    if isinstance(error, WorkFailed) and error.kind != "bug":
        return Problem(500, type_of_failure(error.kind), error.message, error.faults)
    problem = problem_from(error)
    if isinstance(error, InputError):  # who reads a page sends no document again
        count = len(error.faults)
        mend = error.faults[0] if count == 1 else compose("things-to-mend", subject=error.subject, count=count)
        return Problem(problem.status, problem.kind, mend, error.faults)
    return problem


async def signed_in() -> Caller | None:
    """Returns the caller who opens the page; None if an API key must be given first."""
    stored = dict(pages.storage.user)
    return await anyio.to_thread.run_sync(caller_of, service_of_pages(), stored, limiter=_threads)


def serve_page(name: str, page: type[Page], *, paths: Sequence[str], choices: Sequence[str] = ()) -> None:
    """Serves ``page`` at its paths. The values in an address with the names ``choices``, after its ``?`` or in the
    path, are the page's initial selection, search and order."""

    async def serve(request: Request) -> RedirectResponse | None:
        said = {**request.query_params, **request.path_params}
        return await show(name, page, **{key: said.get(key) or None for key in choices})

    for path in paths:
        ui.page(path)(serve)


async def show(name: str, page: type[Page], **initial: str | None) -> RedirectResponse | None:
    """Shows ``page`` to a caller who is signed in; redirects other callers to the page that asks for an API key."""
    caller = await signed_in()
    if caller is None:
        return RedirectResponse("/sign-in")
    with page_frame(name) as frame:
        drawn = page(frame, caller, **initial)
        with anyio.move_on_after(FIRST_LOOK_S):
            await drawn.refresh()
        for kind, address in drawn.preloads():
            ui.add_head_html(f'<link rel="preload" as="{kind}" href="{escape(address)}" {CROSSING[kind]}>')
        drawn.begin()
    return None


def followed_jobs(service: Service, ids: Sequence[str]) -> list[JsonObject]:
    """Returns the progress of the jobs with these ids, in their order. A removed job has the state ``gone``. All open
    pages share one answer."""

    def make() -> list[JsonObject]:
        known = {job.id: job for job in service.jobs.of(ids)}
        return [
            {"id": i, "state": known[i].state, "progress": round(known[i].progress, 2), "frames": known[i].frames}
            if i in known
            else {"id": i, "state": "gone", "progress": 0.0}
            for i in ids
        ]

    return shared.get(("followed", ids), FOLLOW_S / 2, make)


def status_of(service: Service, caller: Caller) -> JsonObject | None:
    """Returns the part of the service's state that every page shows. Returns None if the caller's API key was removed.

    ``faults``: what to do, by faulty part; ``starting``: parts that will be ready soon; ``jobs``: how many are queued
    or run; ``empty``: there is no capture; ``local``: the caller has no API key and needs none."""
    if caller_of(service, {"key_id": caller.key}) is None:
        return None

    def make() -> JsonObject:
        checks = readiness(service)
        wrong = {name: check.detail.document() for name, check in checks.items() if not check.ok and not check.starting}
        starting = [name for name, check in checks.items() if check.starting]
        counts = service.jobs.counts()
        return {
            "faults": wrong,
            "starting": starting,
            "jobs": counts["queued"] + counts["running"],
            "disk": compose("gigabytes-free", gb=service.store.free_bytes() / 1e9).document(),
            "empty": service.captures.newest() is None,
        }

    return shared.get("status", STATUS_S / 2, make) | {"local": caller.key == "local"}


def shown_detail(detail: Message) -> Message:
    """Returns the message of a refusal as a page shows it, without the API's advice to send a document again."""
    faults = detail.parameters.get("found")
    return faults if detail.code == "input-unusable" and isinstance(faults, Message) else detail


def shown_failure(failure: JobError | None) -> JsonObject | None:
    """Returns the document of a job's failure as a page shows it; None if the job has not failed."""
    return failure and failure.model_copy(update={"detail": shown_detail(failure.detail)}).model_dump()

"""Implements the page about the service itself: API keys, retention, and the use of the disk."""

from datetime import UTC, datetime

from nicegui.events import GenericEventArguments

from rig.errors import InputError
from rig.messages.message import Message, compose
from server.console.page import Action, Page, remove_all_later, serve_page, shared
from server.errors import Conflict
from server.services.keys import LOCAL, SCOPES, Caller
from server.services.retention import clear_caches, sweep, upcoming
from server.services.service import Service
from server.services.storage_use import FAILED
from server.settings import PREFIX, ServiceSettings
from server.storage.job_index import JobQuery
from server.storage.records import JsonObject

NAME_MOST = 200
REMOVED_AT_ONCE = 1000
GB = 1e9
MEANINGS = {
    "keep_captures_days": compose("means-keep-captures-days"),
    "keep_results_days": compose("means-keep-results-days"),
    "keep_jobs": compose("means-keep-jobs"),
    "make_room": compose("means-make-room"),
    "free_bytes": compose("means-free-bytes"),
    "cache_bytes": compose("means-cache-bytes"),
    "upload_hours": compose("means-upload-hours"),
}


class ServicePage(Page, component="service.js"):
    """Shows API keys, retention and the use of the disk. The secret of a new key is sent over the page's socket once
    and is never part of the page's state."""

    secret: str | None = None  # of a key that was made a moment ago, until the page has it

    def look(self) -> JsonObject:
        """Returns the state of the page. Only callers with the scope admin see the keys. ``open``: whether there are no
        API keys, so that everybody at this machine may do everything."""
        admin, service, data = self.caller.may("admin"), self.service, str(self.service.store.data.resolve())
        return {
            "keys": [*key_lines(service, self.caller)] if admin else None,
            "open": self.caller.key == LOCAL,
            "scopes": [*SCOPES],
            "admin": admin,
            "retention": setting_lines(service.settings),
            "upcoming": shared.get("upcoming", 5.0, lambda: [one.model_dump() for one in upcoming(service)]),
            "storage": shared.get("storage", 2.0, lambda: service.storage.use().model_dump()) | {"data": data},
        }

    async def _act(self, event: GenericEventArguments) -> None:
        await super()._act(event)
        if self.secret is not None:  # over the page's socket alone, and never in the state that a look makes
            self.run_method("show_key", self.secret)
            self.secret = None


def key_lines(service: Service, caller: Caller) -> list[JsonObject]:
    """Converts all API keys to entries of the list, oldest first. The API key of ``caller`` is marked."""
    return [
        {
            "id": key.id,
            "name": key.name,
            "scopes": [*key.scopes],
            "created": datetime.fromtimestamp(key.created, UTC).isoformat(timespec="seconds"),
            "is_yours": key.id == caller.key,
        }
        for key in service.keys.all()
    ]


def setting_lines(s: ServiceSettings) -> list[JsonObject]:
    """Converts the settings of retention to entries of the page's list, with their values in words."""
    values = {
        "keep_captures_days": _days(s.keep_captures_days),
        "keep_results_days": _days(s.keep_results_days),
        "keep_jobs": compose("keep-all") if s.keep_jobs is None else compose("keep-newest", count=s.keep_jobs),
        "make_room": compose("yes") if s.make_room else compose("no"),
        "free_bytes": compose("gigabytes", gb=s.free_bytes / GB),
        "cache_bytes": compose("gigabytes", gb=s.cache_bytes / GB),
        "upload_hours": compose("hours", hours=s.upload_hours),
    }
    return [
        {"name": name, "variable": PREFIX + name.upper(), "value": value.document(), "means": MEANINGS[name].document()}
        for name, value in values.items()
    ]


def _days(days: float | None) -> Message:
    return compose("for-ever") if days is None else compose("days", days=days)


def add_key(page: ServicePage, event: JsonObject) -> Message:
    """Makes an API key. Raises InputError naming every fault of the form, and Forbidden if there is no API key yet."""
    name, scopes = event["label"].strip(), [scope for scope in SCOPES if scope in event["scopes"]]
    faults = []
    if not name or len(name) > NAME_MOST:
        faults.append(compose("key-name-wanted", most=NAME_MOST))
    if not name.isprintable():
        faults.append(compose("key-name-with-control-characters"))
    if not scopes:
        faults.append(compose("key-scopes-wanted"))
    if faults:
        raise InputError("key", faults)
    page.secret = page.service.keys.add_for(page.caller, name, tuple(scopes))
    return compose("key-made", name=f"{name!r}")


def revoke(page: ServicePage, event: JsonObject) -> Message:
    """Removes an API key. Raises NotFound for an unknown key, and Conflict for the key that the caller uses."""
    if event["id"] == page.caller.key:
        raise Conflict("own-key", compose("own-key"))
    page.service.keys.remove(event["id"])
    return compose("key-revoked")


def clear(page: ServicePage, event: object) -> Message:
    """Removes the caches of all captures that no job needs."""
    gone = clear_caches(page.service)
    forget_storage(page.service)
    return compose("caches-cleared", count=gone)


def remove_failed(page: ServicePage, event: object) -> Message:
    """Removes the failed and cancelled jobs, at most ``REMOVED_AT_ONCE``, after the time to undo has passed. Raises
    Conflict if there are no failed or cancelled jobs."""
    jobs = page.service.jobs
    ids = [job.id for job in jobs.page(JobQuery("", FAILED), REMOVED_AT_ONCE).items]
    if not ids:
        raise Conflict("none-failed", compose("no-job-failed"))
    remove_all_later(ids, jobs.delete, compose("failed-jobs", count=len(ids)), "admin")
    forget_storage(page.service)
    return compose("jobs-removed-count", count=len(ids))


def sweep_now(page: ServicePage, event: object) -> Message:
    """Removes now what retention would remove next. The returned message states how much was removed."""
    gone = {kind: count for kind, count in sweep(page.service).items() if count}
    forget_storage(page.service)
    removed = [compose("gone-of-kind", count=count, kind=kind) for kind, count in gone.items()]
    return compose("swept", gone=removed or compose("nothing-due"))


def forget_storage(service: Service) -> None:
    """Drops the cached figures of the disk and of what retention removes next, which are then computed anew."""
    service.storage.forget()
    shared.forget("storage", "upcoming")


ServicePage.actions = {
    "add_key": Action("admin", add_key),
    "revoke": Action("admin", revoke),
    "clear": Action("admin", clear),
    "remove_failed": Action("admin", remove_failed),
    "sweep": Action("admin", sweep_now),
    "count": Action("read", lambda page, event: forget_storage(page.service)),
}


serve_page("service", ServicePage, paths=("/service",))

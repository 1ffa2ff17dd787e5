"""Implements the page Jobs: queue, progress, log, cancel, restart with other settings, and figures of a job."""

from collections.abc import Callable, Mapping
from typing import cast, get_args

from pipeline.head_model.model_names import list_models
from rig.messages.message import Message, compose
from server.console.page import (
    Action,
    Page,
    remove_all_later,
    remove_later,
    said_unless_refused,
    serve_page,
    shared,
    shown_failure,
)
from server.console.pages.rig import read_report
from server.console.removal import removals
from server.errors import Conflict
from server.services.bulk import apply_each
from server.services.job_rows import FINISHED, STATUSES
from server.services.records import JobOut
from server.services.retention import ENDED
from server.services.service import Service
from server.services.work import ReconstructionRequest
from server.storage.events import JobEvent
from server.storage.job_index import JobOrder, JobQuery
from server.storage.records import JsonObject
from server.tasks.settings_file import settings_of_text

SHOWN = 50  # jobs of a page, and of those that wait before them
SOUGHT_MOST = 1000  # queued jobs among which a search looks for the next ones
ACTIVE = (*STATUSES["running"], *STATUSES["queued"])
ASKED = ("find", "state", "sort", "batch", "after")
LOG_LINES = 200


class JobsPage(Page, component="jobs.js"):
    """Shows the list of jobs, and the selected one with its log and, once it has finished, its figures."""

    def look(self) -> JsonObject:
        """Returns one page of the list, and the selected job with its details, even if it is on another page. Without a
        selection, a running job is selected."""
        requested = {name: self.choice.get(name) or None for name in ASKED}
        state: JsonObject = shared.get(("jobs", *requested.values()), 0.3, lambda: jobs_state(self.service, requested))
        first = next((job for job in state["jobs"] if job["state"] == "running"), next(iter(state["jobs"]), None))
        chosen = self.choice.get("job")
        known = next((job for job in state["jobs"] if job["id"] == chosen), None)
        if known is None and chosen and chosen not in removals:
            known = next((job_line(self.service, job) for job in self.service.jobs.of([chosen])), None)
        job = known or first
        return {**state, "job": job, "detail": None if job is None else job_detail(self.service, job["id"])}


def jobs_state(service: Service, requested: Mapping[str, str | None]) -> JsonObject:
    """Returns one page of the jobs that match the request: running jobs, then the queue in its order, then ended jobs,
    newest first. ``waiting`` is the number of further waiting jobs."""
    sought, after = requested["find"] or "", requested["after"]
    order = cast(JobOrder, requested["sort"] if requested["sort"] in get_args(JobOrder) else "-created")
    state = requested["state"] if requested["state"] in STATUSES else None
    statuses = ENDED if state is None else STATUSES[state]
    batch = requested["batch"]
    before, waiting = ([], 0) if after or state else active_jobs(service, sought, batch)
    if state == "queued":
        before, waiting, statuses = *active_jobs(service, sought, batch, running=False), ()
    page = service.jobs.page(JobQuery(sought, statuses, batch=batch, order=order), SHOWN, after)
    jobs = [job for job in (*before, *page.items) if job.id not in removals]
    return {
        "jobs": [job_line(service, job) for job in jobs],
        "counts": shared.get("job counts", 1.0, service.jobs.counts),
        "waiting": waiting,
        "next": page.next,
        "total": page.total + len(before) + waiting,
        "models": shared.get("models", 30.0, lambda: list(list_models())),
    }


def active_jobs(service: Service, sought: str, batch: str | None, *, running: bool = True) -> tuple[list[JobOut], int]:
    """Returns at most ``SHOWN`` jobs, the running ones and then the next waiting ones, and the number of further
    waiting jobs. With ``running`` the list includes the running jobs."""
    query = JobQuery(sought, ACTIVE if running else STATUSES["queued"], batch=batch)
    matching = service.jobs.page(query, SOUGHT_MOST)
    jobs = sorted(matching.items, key=lambda job: (job.state != "running", job.ahead or 0, job.id))
    return jobs[:SHOWN], matching.total - min(SHOWN, len(jobs))


def capture_of(service: Service, job: JobOut) -> JsonObject:
    """Returns label (``capture``), time (``captured``) and session of a job's capture, as far as the capture exists."""
    for record in service.captures.of([job.capture_id or ""]):
        return {"capture": record.label, "captured": record.created, "session": record.session}
    return {"capture": "", "captured": None, "session": job.session}


def job_line(service: Service, job: JobOut) -> JsonObject:
    """Converts a job to an entry of the page's list: its fields, with the label and time of its capture."""
    line = job.model_dump(exclude={"files"}) | {"error": shown_failure(job.error)}
    return capture_of(service, job) | line


def job_detail(service: Service, job_id: str) -> JsonObject:
    """Returns the log of a job and, once it has finished, the report of each camera, the warnings, and whether there
    are pictures. After the job has finished, these values are cached for an hour. Raises NotFound."""
    finished = service.jobs.state(job_id) in FINISHED

    def make() -> JsonObject:
        events = service.jobs.events.since(job_id, 0, limit=10_000)
        report = read_report(service, job_id) if finished else None
        cameras = {} if report is None or "frames" in report else report.get("cameras", {})  # a film has no figures
        return {
            "id": job_id,
            "log": log_lines(events)[-LOG_LINES:],
            "cameras": [{"name": name, **camera} for name, camera in cameras.items()],
            "warnings": [] if report is None else report.get("warnings", []),
            "seconds": {} if report is None else report.get("seconds", {}),
            "stopped_because": None if report is None else report.get("stopped_because"),
            "evaluations": None if report is None else report.get("evaluations"),
            "pictures": bool(cameras),
        }

    return shared.get(("detail", job_id, finished), 3600.0 if finished else 0.4, make)


def log_lines(events: list[JobEvent]) -> list[JsonObject]:
    """Returns when each stage or state of a job began, in seconds after the first event."""
    lines: list[JsonObject] = []
    for event in events:
        text = event.document.get("stage") or event.document.get("state") or ""
        if not lines or lines[-1]["text"] != text:
            lines.append({"at_s": round(event.at - events[0].at, 1), "text": text})
    return lines


def restart(page: Page, event: JsonObject) -> Message:
    """Queues and selects a new job for the capture of an earlier job. Raises what ``Jobs.restart`` raises."""
    wanted = ReconstructionRequest(event.get("model") or None, chosen_settings(event))
    job = page.service.jobs.restart(event["id"], wanted, key=page.caller.key)
    page.choice["job"] = job.id
    page.started(job.id, opens=job.frames is None)
    return compose("job-queued", job=job.id[-6:])


def chosen_settings(event: JsonObject) -> Mapping[str, object]:
    """Reads the settings of a form: method, detail, front, and further ones from the JSON text ``more``. Raises
    InputError if ``more`` is no JSON object."""
    settings = settings_of_text(event.get("more") or "{}")
    return settings | {key: event.get(key) for key in ("method", "detail", "front") if event.get(key)}


def cancel(page: Page, event: JsonObject) -> None:
    """Cancels a job. A finished job stays as it is. Raises NotFound."""
    page.service.cancel(event["id"])


def delete(page: Page, event: JsonObject) -> None:
    """Removes a job with its result after the time to undo has passed. Raises NotFound."""
    service, identity = page.service, event["id"]
    service.jobs.get(identity)
    remove_later(identity, lambda: service.jobs.delete(identity), compose("job-named", job=identity[-6:]), "submit")


def bulk(page: Page, event: JsonObject) -> Message:
    """Applies one ``action`` (cancel, restart, remove) to all ticked jobs, ``ids``. If the action is refused for some
    jobs, it is applied to the others, and InvalidInput is raised with the reasons. Raises Conflict if all jobs to be
    removed are still active."""
    service, action = page.service, event["action"]
    if action == "remove":
        ended = [job.id for job in service.jobs.of(event["ids"]) if job.state in FINISHED]
        if not ended:
            raise Conflict("job-active", compose("jobs-active"))
        remove_all_later(ended, service.jobs.delete, compose("jobs-with-heads", count=len(ended)), "submit")
        return compose("jobs-removed-count", count=len(ended))
    restarted, begun = ReconstructionRequest(), list[str]()
    actions: dict[str, Callable[[str], object]] = {
        "cancel": service.cancel,
        "restart": lambda job: begun.append(service.jobs.restart(job, restarted, key=page.caller.key).id),
    }
    done = apply_each(event["ids"], actions[action])
    page.started(*begun)
    shared.forget("jobs")
    count = len(done.done)
    said = compose("jobs-cancelled", count=count) if action == "cancel" else compose("jobs-queued-again", count=count)
    return said_unless_refused(said, done)


JobsPage.actions = {
    "bulk": Action("submit", bulk),
    "restart": Action("submit", restart),
    "cancel": Action("submit", cancel),
    "delete": Action("submit", delete),
}


serve_page("jobs", JobsPage, choices=("job", "find", "state", "sort", "batch"), paths=("/jobs",))

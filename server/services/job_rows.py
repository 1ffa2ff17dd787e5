"""Translates the job engine's rows: names of its workflows, and the contents of its rows in the service's terms."""

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

from dbos import EnqueueOptions, WorkflowStatus

from server.services.answer import State
from server.services.records import moment_of
from server.storage.job_index import JobQuery
from server.storage.records import JobRequest

APPLICATION = "eigenhead"
APPLICATION_VERSION = "eigenhead-jobs-1"  # pinned: a job outlives an upgrade; changes only with the steps themselves
WORKFLOW = "reconstruct"
DELIVERY = "deliver"
STATES: Mapping[str, State] = {
    "DELAYED": "queued",
    "ENQUEUED": "queued",
    "PENDING": "running",
    "SUCCESS": "succeeded",
    "ERROR": "failed",
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": "failed",
    "CANCELLED": "cancelled",
}
STATUSES: Mapping[str, list[str]] = {
    state: [s for s, t in STATES.items() if t == state] for state in set(STATES.values())
}
FINISHED = ("succeeded", "failed", "cancelled")


def enqueue_options(workflow: str, queue: str, identity: str) -> EnqueueOptions:
    """Returns the job engine's options to queue a workflow under an id."""
    return {"workflow_name": workflow, "queue_name": queue, "workflow_id": identity, "app_version": APPLICATION_VERSION}


def by_state(query: JobQuery) -> JobQuery:
    """Returns a query in which search words that are names of states select jobs in those states."""
    words = query.sought.split()
    states = [word.casefold() for word in words if word.casefold() in STATUSES]
    if not states:
        return query
    statuses = [status for state in states for status in STATUSES[state]]
    both = statuses if query.statuses is None else [status for status in statuses if status in query.statuses]
    rest = " ".join(word for word in words if word.casefold() not in STATUSES)
    return replace(query, sought=rest, statuses=both)


def request_of(row: WorkflowStatus) -> JobRequest | None:
    """Returns a copy of a job's request; None if the row's input cannot be read."""
    return cast(JobRequest, dict(row.input["args"][0])) if row.input else None


def moment(milliseconds: int | None) -> str | None:
    """Converts a time in ms since 1970 to text."""
    return None if milliseconds is None else moment_of(milliseconds)

"""Describes how a job failed: the exception that the job engine stores, and the failure that clients get."""

from collections.abc import Iterable
from typing import Any

import structlog
from dbos import WorkflowStatus

from rig.errors import EigenheadError
from rig.messages.message import Message, MessageDocument, compose, documents_of, read_message
from server.problem_types import URN
from server.services.records import Failure

Kept = str | MessageDocument  # texts are those of earlier versions

log = structlog.get_logger()


class JobFailed(EigenheadError):
    """Reports a job that cannot succeed, however often it is repeated. The job engine pickles it as the workflow's
    error; the pickle holds plain values only, so that later versions can read it."""

    def __init__(self, kind: str, detail: Message | Kept, errors: Iterable[Message | Kept] = ()) -> None:
        super().__init__(_read(detail))
        self.kind, self.detail, self.errors = kind, self.message, tuple(map(_read, errors))
        # What the engine pickles, and restores the error with; plain values outlast a change of our own classes.
        self.args = (kind, self.detail.document(), tuple(documents_of(self.errors)))

    def __str__(self) -> str:
        return self.detail.text

    def __reduce__(self) -> tuple[type["JobFailed"], tuple[Any, ...]]:
        return JobFailed, self.args

    def __setstate__(self, state: object) -> None:
        """Earlier versions stored the attributes as well, as texts; the arguments say all of it."""


def _read(kept: Message | Kept) -> Message:
    return kept if isinstance(kept, Message) else read_message(kept)


def failure(row: WorkflowStatus) -> Failure:
    """Returns why the job of a workflow's row failed. An error that is no JobFailed is logged and becomes
    "internal-error"; a job that took too many workers down becomes "worker-died"."""
    error = row.error
    if isinstance(error, JobFailed):
        return Failure(URN + error.kind, error.detail, error.errors)
    if row.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
        return Failure(URN + "worker-died", compose("worker-died"))
    log.error("job failed in an unforeseen way", job=row.workflow_id, error=str(error))
    return Failure(URN + "internal-error", compose("job-failed-unforeseen"))

"""Describes how a job failed: the exception that the job engine stores, and the failure that clients get.

The job engine keeps requests, results and errors as JSON (``SERIALIZER``). Rows of the job database from versions
before 0.3 are pickled; reading such rows builds only plain values and JobFailed, so no row can run code.
"""

import base64
import io
import pickle
from collections.abc import Iterable
from typing import Any, cast

import structlog
from dbos import DBOSPortableJSONSerializer, PortableWorkflowError, WorkflowStatus
from dbos._serialization import DefaultSerializer

from rig.errors import EigenheadError
from rig.messages.message import Message, MessageDocument, compose, documents_of, read_message
from server.problem_types import URN
from server.services.records import JobError

Kept = str | MessageDocument  # texts are those of earlier versions

SERIALIZER = DBOSPortableJSONSerializer()

log = structlog.get_logger()


class JobFailed(EigenheadError):
    """Reports a job that cannot succeed, however often it is repeated. The job engine stores the error's ``data``."""

    def __init__(self, kind: str, detail: Message | Kept, errors: Iterable[Message | Kept] = ()) -> None:
        super().__init__(_read(detail))
        self.kind, self.detail, self.errors = kind, self.message, tuple(map(_read, errors))
        self.data = {"kind": kind, "detail": self.detail.document(), "errors": documents_of(self.errors)}

    def __str__(self) -> str:
        return self.detail.text

    def __setstate__(self, state: object) -> None:
        """Ignores an error's attributes, which earlier versions also stored: its arguments contain the same data."""


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[JobFailed]:
        if name == JobFailed.__name__:  # whatever the module was called then: nothing is imported
            return JobFailed
        raise pickle.UnpicklingError(f"{module}.{name}")


def _read_pickled(cls: DefaultSerializer, serialized_data: str) -> Any:
    return _PlainUnpickler(io.BytesIO(base64.b64decode(serialized_data))).load()


DefaultSerializer.deserialize = _read_pickled


def restore_failure(error: Exception | None) -> JobFailed | None:
    """Returns the JobFailed that the job engine kept as ``error``; None for any other error."""
    if isinstance(error, PortableWorkflowError) and error.name == JobFailed.__name__ and isinstance(error.data, dict):
        return JobFailed(**cast(dict[str, Any], error.data))
    return error if isinstance(error, JobFailed) else None


def _read(kept: Message | Kept) -> Message:
    return kept if isinstance(kept, Message) else read_message(kept)


def failure(row: WorkflowStatus) -> JobError:
    """Returns why the job of a workflow's row failed. An error other than JobFailed is logged and becomes
    "internal-error"; a job that killed too many workers becomes "worker-died"."""
    error = row.error
    if (failed := restore_failure(error)) is not None:
        return JobError(type=URN + failed.kind, detail=failed.detail, errors=failed.errors)
    if row.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
        return JobError(type=URN + "worker-died", detail=compose("worker-died"), errors=())
    log.error("job failed in an unforeseen way", job=row.workflow_id, error=str(error))
    return JobError(type=URN + "internal-error", detail=compose("job-failed-unforeseen"), errors=())

"""Describes why a capture of a batch failed, with messages that say what to do in a batch."""

from pathlib import Path

from rig.errors import EigenheadError, InputError
from rig.messages.message import Message, compose
from server.batch.folder import FailureRecord, Origin
from server.tasks.child import DISK_FULL, WorkFailed

SIGKILL = 9


def failure_of(error: EigenheadError | OSError, capture: Path, origin: Origin | None) -> FailureRecord:
    """Returns the failure record for an error. ``origin``: None if the capture could not be read."""
    if isinstance(error, WorkFailed):
        return FailureRecord(error.kind, _of_work(error), error.faults, origin, error.trace)
    if isinstance(error, EigenheadError):
        kind = "input" if isinstance(error, InputError) else "refused"
        return FailureRecord(kind, error.message, getattr(error, "faults", ()), origin)
    if error.errno in DISK_FULL:
        return FailureRecord("disk-full", compose("batch-disk-full"), (), origin)
    reason = error.strerror or str(error)
    if origin is None:
        message = compose("batch-capture-unreadable", path=str(capture), reason=reason)
        return FailureRecord("input", message, (), origin)
    message = compose("batch-result-unwritable", path=str(error.filename or ""), reason=reason)
    return FailureRecord("unwritable", message, (), origin)


def _of_work(error: WorkFailed) -> Message:
    how = error.message.parameters.get("how")
    if error.kind == "crash" and isinstance(how, Message) and how.parameters.get("number") == SIGKILL:
        return compose("batch-worker-killed")
    if error.kind == "disk-full":
        return compose("batch-disk-full")
    if error.kind == "out-of-memory":
        return compose("batch-out-of-memory")
    return error.message

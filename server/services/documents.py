"""Documents of the service as its clients get them: the command line's, and the pages' components."""

from typing import TypedDict

from rig.acquisition.shot import FaultDocument
from rig.messages.message import MessageDocument, documents_of, texts_of
from server.services.records import Failure


class SizeDocument(TypedDict):
    name: str
    width: int
    height: int


class CaptureDocument(TypedDict):
    id: str
    created: str
    source: str
    session: str | None
    label: str
    expression: str
    cameras: list[SizeDocument]
    front: str
    features: bool
    board: bool
    bytes: int
    inputs: dict[str, str]
    shot: dict[str, object] | None
    verdict: str | None
    faults: list[FaultDocument]


class ErrorDocument(TypedDict):
    type: str
    detail: str
    errors: list[str]
    detail_message: MessageDocument
    error_messages: list[MessageDocument]


class FileDocument(TypedDict):
    bytes: int
    sha256: str


class JobLine(TypedDict):
    """Holds a job without its files, as a list shows it."""

    id: str
    state: str
    stage: str
    progress: float
    eta_s: float | None
    error: ErrorDocument | None
    notice: str | None
    notice_message: MessageDocument | None
    capture_id: str | None
    session: str | None
    model: str | None
    settings: dict[str, object]
    restart_of: str | None
    queue: str | None
    priority: int
    queue_position: int | None
    created: str | None
    started: str | None
    finished: str | None


class JobDocument(JobLine):
    """A job with the files of its result, by name."""

    files: dict[str, FileDocument]


def failure_document(failure: Failure) -> ErrorDocument:
    """Returns a failure as clients get it."""
    return {
        "type": failure.type,
        "detail": failure.detail.text,
        "errors": texts_of(failure.errors),
        "detail_message": failure.detail.document(),
        "error_messages": documents_of(failure.errors),
    }

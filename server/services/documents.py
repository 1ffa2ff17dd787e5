"""Declares the JSON documents in which the command line and the components of the pages receive captures, jobs and
failures."""

from typing import TypedDict

from rig.acquisition.shot import FaultDocument
from rig.messages.message import MessageDocument, documents_of, texts_of
from server.services.records import Failure


class SizeDocument(TypedDict):
    """Holds the name of a camera and the size of its pictures in pixels."""

    name: str
    width: int
    height: int


class CaptureDocument(TypedDict):
    """Holds a capture as the HTTP interface answers it; the fields are those of ``CaptureRecord``. ``inputs`` has the
    SHA-256 of every file by name."""

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
    """Holds why a job failed: the problem's ``type`` (a URN), English texts, and the same texts as messages (code and
    parameters) for translation."""

    type: str
    detail: str
    errors: list[str]
    detail_message: MessageDocument
    error_messages: list[MessageDocument]


class FileDocument(TypedDict):
    """Holds size and SHA-256 of a file of a result."""

    bytes: int
    sha256: str


class JobLine(TypedDict):
    """Holds a job as a list shows it, without the files of its result. ``progress`` runs from 0 to 1, ``eta_s`` is the
    estimated remaining time in seconds; ``notice`` says why a queued job cannot begin, or that its result is gone."""

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
    """Holds a job with the files of its result, by name."""

    files: dict[str, FileDocument]


def failure_document(failure: Failure) -> ErrorDocument:
    """Returns the JSON document of a job's failure."""
    return {
        "type": failure.type,
        "detail": failure.detail.text,
        "errors": texts_of(failure.errors),
        "detail_message": failure.detail.document(),
        "error_messages": documents_of(failure.errors),
    }

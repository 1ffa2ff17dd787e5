"""What the services give to routes, pages and the command line."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from rig.messages.message import Message
from server.storage.records import FileEntry

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Found(Generic[T]):
    """Holds one page of a list: ``next`` is the cursor of the page after it, None on the last; ``total`` counts what
    all pages hold."""

    items: tuple[T, ...]
    next: str | None
    total: int


@dataclass(frozen=True, slots=True)
class Failure:
    """States why a job failed: a stable ``type``, what to do, and every fault."""

    type: str
    detail: Message
    errors: tuple[Message, ...] = ()


@dataclass(frozen=True, slots=True)
class Job:
    """Holds a job at this moment. ``notice`` says why a queued one cannot begin, or that a result is gone;
    ``queue_position`` is how many jobs of its queue go before a queued one; ``files`` are those of a result, by
    name."""

    id: str
    name: str
    state: str
    stage: str
    progress: float
    eta_s: float | None
    error: Failure | None
    notice: Message | None
    capture_id: str | None
    session: str | None
    model: str | None
    settings: Mapping[str, object]
    restart_of: str | None
    queue: str | None
    priority: int
    queue_position: int | None
    created: str | None
    started: str | None
    finished: str | None
    files: dict[str, FileEntry]


@dataclass(frozen=True, slots=True)
class Session:
    """Holds one subject's session with the ids of its captures."""

    id: str
    created: str
    label: str
    consent: str
    captures: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Subject:
    """Holds one person: sessions of one name, newest first, with how many captures they have; ``id`` is the newest
    session's. ``head``: the newest job with a result, ``heads`` how many there are; ``tags``: of their captures."""

    id: str
    label: str
    created: str
    sessions: tuple[str, ...]
    captures: int
    heads: int
    running: int
    head: str | None
    capture: str | None
    consent: bool
    tags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Holds a calibration and, once it succeeded, what it found. ``pictures``: their number by camera; ``kind``: of
    what they are, board or scene; ``stage``, ``progress`` (0 to 1) and remaining seconds of one that runs; ``missing``:
    what would make its verdict better."""

    id: str
    created: str
    source: str
    label: str
    pictures: dict[str, int]
    kind: str
    state: str
    stage: str | None = None
    progress: float = 0.0
    eta_s: float | None = None
    error: Failure | None = None
    verdict: str | None = None
    missing: tuple[Message, ...] = ()
    figures: Mapping[str, object] = field(default_factory=dict)
    checks: tuple[Mapping[str, object], ...] = ()
    warnings: tuple[Message, ...] = ()
    front: str | None = None
    in_use: bool = False


@dataclass(frozen=True, slots=True)
class RigCamera:
    name: str
    driver: str
    state: str


@dataclass(frozen=True, slots=True)
class RigState:
    """Holds the rig at this moment; ``calibration`` is whose it is: "own", "studio", or None where there is none."""

    id: str
    kind: str
    ready: bool
    cameras: tuple[RigCamera, ...]
    faults: tuple[Message, ...]
    calibration: str | None


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Holds what a camera was set to (None: left as the camera has it); ``unmet`` has a line for each it did not
    take."""

    exposure_ms: float | None
    gain_db: float | None
    white_balance_k: int | None
    unmet: tuple[Message, ...]


@dataclass(frozen=True, slots=True)
class CleanPlates:
    """Holds the cameras of which clean plates were taken, and how many of each."""

    cameras: tuple[str, ...]
    plates: int
    note: Message | None


@dataclass(frozen=True, slots=True)
class Webhook:
    id: str
    url: str


@dataclass(frozen=True, slots=True)
class NewWebhook(Webhook):
    """``secret`` signs the messages."""

    secret: str

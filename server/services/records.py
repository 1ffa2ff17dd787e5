"""What the services give to routes, pages and the command line."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Generic, TypeVar

from rig.messages.message import Message
from server.storage.records import FileEntry

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Found(Generic[T]):
    """Holds one page of a list. ``next``: cursor of the next page, None on the last; ``total``: number of items on all
    pages."""

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
class Delivery:
    """States where a job's result is delivered to, and how far that is: waiting, delivering, delivered, failed or
    cancelled."""

    to: str
    state: str
    error: Failure | None


@dataclass(frozen=True, slots=True)
class Job:
    """Holds a job at one moment.

    ``notice``: why a queued job cannot begin, or that its result is gone; ``queue_position``: how many jobs go before a
    queued one; ``files``: size and SHA-256 of the result's files, by name.
    """

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
    delivery: Delivery | None = None


@dataclass(frozen=True, slots=True)
class Batch:
    """Holds a batch at one moment.

    ``counts``: captures by state, those of ``ITEM_STATES``; ``total``: their sum; ``eta_s``: estimated remaining
    seconds, None where nothing says them; ``notice``: why its jobs cannot begin.
    """

    id: str
    label: str
    state: str
    created: str
    finished: str | None
    queue: str
    priority: int
    model: str | None
    settings: Mapping[str, object]
    deliver_to: str | None
    total: int
    counts: Mapping[str, int]
    eta_s: float | None
    notice: Message | None


@dataclass(frozen=True, slots=True)
class Session:
    """Holds one session of a subject, with the ids of its captures."""

    id: str
    created: str
    label: str
    consent: str
    captures: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Subject:
    """Holds one person: the sessions of one name, newest first, with their captures.

    ``id``: that of the newest session; ``head``: the newest job with a result; ``heads``: number of such jobs;
    ``tags``: those of the captures.
    """

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
    """Holds a calibration and, once it succeeded, its outcome.

    ``pictures``: number by camera; ``kind``: what they show, board or scene; ``stage``, ``progress`` (0 to 1) and
    remaining seconds while it runs; ``missing``: what would make its verdict better.
    """

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
    """Holds the state of the rig at one moment. ``calibration``: "own" where the rig has a cameras.json, "studio" for
    the simulated studio without one, else None."""

    id: str
    kind: str
    ready: bool
    cameras: tuple[RigCamera, ...]
    faults: tuple[Message, ...]
    calibration: str | None


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Holds the settings of a camera (None: the camera's own choice). ``unmet``: one message for each setting that the
    camera did not take."""

    exposure_ms: float | None
    gain_db: float | None
    white_balance_k: int | None
    unmet: tuple[Message, ...]


@dataclass(frozen=True, slots=True)
class CleanPlates:
    """Holds of which cameras clean plates were taken, and how many of each."""

    cameras: tuple[str, ...]
    plates: int
    note: Message | None


@dataclass(frozen=True, slots=True)
class Webhook:
    id: str
    url: str


@dataclass(frozen=True, slots=True)
class NewWebhook(Webhook):
    """Holds a webhook that was just added. ``secret`` signs the messages."""

    secret: str


def moment_of(milliseconds: int) -> str:
    """Returns a time in ms since 1970 as text."""
    return datetime.fromtimestamp(milliseconds / 1000, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

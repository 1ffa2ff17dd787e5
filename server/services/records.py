"""Declares the values that the services return to routes, pages and the command line."""

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
    """Holds why a job failed: the problem's ``type`` (a URN that stays the same across versions), what went wrong and
    what to do, and every fault found."""

    type: str
    detail: Message
    errors: tuple[Message, ...] = ()


@dataclass(frozen=True, slots=True)
class Job:
    """Holds the state of a job at one moment.

    ``progress`` runs from 0 to 1; ``eta_s`` is the estimated remaining time (s). ``notice`` says why a queued job
    cannot begin, or that the files of its result are gone. ``queue_position`` counts the jobs that go before a queued
    one. ``files`` has size and SHA-256 of the result's files, by name.
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


@dataclass(frozen=True, slots=True)
class Batch:
    """Holds the state of a batch at one moment.

    ``counts``: number of captures in each state of ``ITEM_STATES``; ``total``: their sum; ``eta_s``: estimated
    remaining time (s), None if it cannot be estimated; ``notice``: why its jobs cannot begin.
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
    total: int
    counts: Mapping[str, int]
    eta_s: float | None
    notice: Message | None


@dataclass(frozen=True, slots=True)
class Session:
    """Holds a session: the ids of captures of one subject, and the note of the subject's consent."""

    id: str
    created: str
    label: str
    consent: str
    captures: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Subject:
    """Holds a person: the sessions with the same name, newest first.

    ``id``, ``label`` and ``created`` are those of the newest session; ``captures``, ``heads`` and ``running`` count
    captures, succeeded jobs, and queued or running jobs. ``head`` is the newest succeeded job, ``capture`` a capture to
    show, ``consent`` whether every session has a note of it.
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
    """Holds a calibration and, once it has succeeded, its outcome.

    ``pictures``: number of pictures by camera; ``kind``: what they show ("board", "scene"); ``stage``, ``progress`` (0
    to 1) and ``eta_s`` (s): how far a running one is; ``missing``: what would improve its verdict.
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
    """Holds a camera of the rig and its state: "closed" before it is first used, "open", "missing", or "ready" in the
    simulated studio."""

    name: str
    driver: str
    state: str


@dataclass(frozen=True, slots=True)
class RigState:
    """Holds the state of the rig at one moment. ``faults`` say what it lacks. ``calibration``: "own" if the rig has a
    cameras.json, "studio" for the simulated studio without one, None for a real rig without one."""

    id: str
    kind: str
    ready: bool
    cameras: tuple[RigCamera, ...]
    faults: tuple[Message, ...]
    calibration: str | None


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Holds the settings that were requested of a camera (None: the camera decides). ``unmet`` has a message for each
    setting that the camera did not take."""

    exposure_ms: float | None
    gain_db: float | None
    white_balance_k: int | None
    unmet: tuple[Message, ...]


@dataclass(frozen=True, slots=True)
class CleanPlates:
    """Holds of which cameras clean plates were taken, and how many of each. ``note`` is for the operator."""

    cameras: tuple[str, ...]
    plates: int
    note: Message | None


@dataclass(frozen=True, slots=True)
class Webhook:
    """Holds a webhook: the address to which the service announces the end of jobs and batches."""

    id: str
    url: str


@dataclass(frozen=True, slots=True)
class NewWebhook(Webhook):
    """Holds a webhook that was just added, with the secret that signs its messages. The secret is not shown again."""

    secret: str


def moment_of(milliseconds: int) -> str:
    """Formats a time in milliseconds since 1970 as ISO 8601 in UTC, such as 2026-01-31T12:00:00.000Z."""
    return datetime.fromtimestamp(milliseconds / 1000, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

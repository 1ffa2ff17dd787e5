"""Declares the documents of jobs, batches, sessions, calibrations, the rig and webhooks."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from pydantic import Field

from rig.acquisition.verdict import Verdict
from rig.messages.message import Message
from server.services.answer import Answer, JobSettings, MessageOut, Moment, Said, State, as_data
from server.storage.batches import BatchState
from server.storage.records import JsonObject


class JobError(Answer):
    """Describes why a job failed. ``type`` and ``detail`` are as in a problem document."""

    type: str
    detail: Said
    detail_message = as_data("detail")
    errors: tuple[Said, ...]
    error_messages = as_data("errors", list[MessageOut])


class FileOut(Answer):
    """Describes a file by its size in bytes and its SHA-256."""

    bytes: int
    sha256: str


class DeliveryOut(Answer):
    """States the destination and progress of a delivery of a job's result."""

    to: str = Field(description="where the files lie once they are delivered; delivery.json is the last of them")
    state: Literal["waiting", "delivering", "delivered", "failed", "cancelled"]
    error: JobError | None


class JobOut(Answer):
    """Describes a job: its request, state and progress and, once it has succeeded, the files of its result. ``eta_s``
    is the estimated remaining time in seconds."""

    id: str
    name: str
    state: State
    stage: str
    progress: float = Field(ge=0, le=1)
    eta_s: float | None
    frames: int | None = Field(None, description="of a film")
    frames_done: int | None = Field(None, description="of a film that is or was tracked")
    error: JobError | None
    notice: Said | None = Field(None, description="why a queued job cannot begin or a result is gone; what to do")
    notice_message = as_data("notice", MessageOut | None)
    capture_id: str | None
    session: str | None
    model: str | None
    settings: JobSettings
    restart_of: str | None
    queue: str | None
    priority: int
    ahead: int | None = Field(None, description="jobs of its queue that go before a queued one")
    created: Moment | None
    started: Moment | None
    finished: Moment | None
    files: dict[str, FileOut]
    delivery: DeliveryOut | None = None


class BatchCounts(Answer):
    """Counts the captures of a batch by state."""

    waiting: int = Field(description="without a job yet")
    queued: int
    running: int
    succeeded: int
    failed: int
    cancelled: int
    removed: int = Field(description="whose capture, or whose job, is gone")


class BatchOut(Answer):
    """Describes a batch: its request, its state, and how many of its captures are in which state."""

    id: str
    label: str
    state: BatchState = Field(description="finished: nothing is left to do; a cancelled one stays cancelled")
    created: Moment
    finished: Moment | None
    queue: str
    priority: int
    model: str | None
    settings: JobSettings
    deliver_to: str | None
    total: int = Field(description="captures")
    counts: BatchCounts
    eta_s: float | None = Field(description="by the mean of its jobs so far; null before one succeeded")
    notice: Said | None = Field(None, description="why its jobs cannot begin; what to do")
    notice_message = as_data("notice", MessageOut | None)


class SessionOut(Answer):
    """Describes a session with the ids of its captures, newest first."""

    id: str
    created: Moment
    label: str
    consent: str
    captures: list[str]


class PersonOut(Answer):
    """Describes a person whose sessions have the same name. ``captures`` counts captures, ``heads`` jobs that made a
    head."""

    id: str = Field(description="of the newest session")
    label: str
    created: Moment
    sessions: list[str]
    captures: int
    heads: int
    running: int = Field(description="jobs that are queued or running")
    head: str | None = Field(description="newest job with a result")
    capture: str | None = Field(description="newest capture")
    consent: bool = Field(description="whether every session has a note of it")
    tags: list[str] = Field(description="of their captures")


class CalibrationOut(Answer):
    """Describes a calibration: the state of its job and, once it has succeeded, figures, checks and the verdict.
    ``progress`` runs from 0 to 1; ``eta_s`` is the estimated remaining time in seconds."""

    id: str
    created: Moment
    source: Literal["upload", "rig"]
    label: str
    pictures: dict[str, int] = Field(description="number of pictures by camera")
    kind: Literal["board", "scene"] = Field("board", description="what the pictures show")
    state: State
    stage: str | None = None
    progress: float = Field(0.0, ge=0, le=1)
    eta_s: float | None = None
    error: JobError | None
    verdict: Verdict | None = Field(None, description="null: not judged")
    missing: tuple[Said, ...] = Field((), description="what would make the verdict better, most urgent first")
    missing_messages = as_data("missing", list[MessageOut])
    figures: JsonObject
    checks: tuple[JsonObject, ...]
    warnings: tuple[Said, ...]
    warning_messages = as_data("warnings", list[MessageOut])
    front: str | None
    in_use: bool


class CameraOut(Answer):
    """Describes a camera of the rig: ``closed`` if it was not used since the start, ``ready`` if simulated."""

    name: str
    driver: str
    state: Literal["ready", "open", "closed", "missing"]


class RigOut(Answer):
    """Describes the rig. ``calibration``: ``own`` if the rig has a calibration, ``studio`` for the simulated studio
    without one, null for a real rig without one."""

    id: str
    kind: Literal["simulated", "real"]
    ready: bool
    cameras: list[CameraOut]
    faults: tuple[Said, ...]
    fault_messages = as_data("faults", list[MessageOut])
    calibration: str | None


class CameraSettingsOut(Answer):
    """Holds the settings requested of a camera (null: the camera decides), and which of them the camera rejected."""

    exposure_ms: float | None
    gain_db: float | None
    white_balance_k: int | None
    unmet: tuple[Said, ...] = Field(description="what the camera did not take, and why")
    unmet_messages = as_data("unmet", list[MessageOut])


@dataclass(frozen=True, slots=True)
class CleanPlates:
    """Holds the cameras of the clean plates, and the number of plates of each. ``note`` is for the operator."""

    cameras: tuple[str, ...]
    plates: int
    note: Message | None


class WebhookOut(Answer):
    """Describes a webhook without its secret."""

    id: str
    url: str


class NewWebhookOut(WebhookOut):
    """Describes a webhook that was just added, with its secret."""

    secret: str = Field(description="shown this once; signs the messages (standardwebhooks.com)")


def moment_now() -> str:
    """Returns the current time in the form of ``moment_of``."""
    return moment_of(1000.0 * time.time())


def moment_of(milliseconds: float) -> str:
    """Formats a time in milliseconds since 1970 as ISO 8601 in UTC, such as 2026-01-31T12:00:00.000Z."""
    return datetime.fromtimestamp(milliseconds / 1000, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

"""Defines a shot: pictures that all cameras took at one time, the certificate of their timing, and all faults.

This module judges only timing. ``rig.acquisition.judgement`` judges pictures; ``rig.acquisition.session`` takes
shots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Literal, TypedDict

from rig.acquisition.image_checks import Exposure, Registration
from rig.drivers.base import Frame
from rig.errors import EigenheadError
from rig.image import ImageRgb
from rig.messages.message import Message, MessageDocument, compose, read_message

Status = Literal["in sync", "late", "dropped", "missing", "recorded"]

REMEDIES: dict[str, Message] = {
    "trigger": compose("remedy-trigger"),
    "late-trigger": compose("remedy-late-trigger"),
    "missing": compose("remedy-missing"),
    "dropped": compose("remedy-dropped"),
    "late": compose("remedy-late"),
    "frozen": compose("remedy-frozen"),
    "size": compose("remedy-size"),
    "lights-off": compose("remedy-lights-off"),
    "dark": compose("remedy-dark"),
    "swapped": compose("remedy-swapped"),
    "view": compose("remedy-view"),
    "moved": compose("remedy-moved"),
    "overexposed": compose("remedy-overexposed"),
    "blurred": compose("remedy-blurred"),
    "setting": compose("remedy-setting"),
    "plates": compose("remedy-plates"),
    "empty": compose("remedy-empty"),
    "cut-off": compose("remedy-cut-off"),
    "disturbed": compose("remedy-disturbed"),
    "occupied": compose("remedy-occupied"),
}
WARNINGS = frozenset({"moved", "overexposed", "blurred", "setting", "plates", "empty", "cut-off"})
"""Faults with which a capture is still worth reconstructing; the others end it."""

DROPPED_PERIODS = 0.8  # a frame late by so many periods of the live view is the next one: its own was dropped


class FaultDocument(TypedDict):
    """Holds a fault as plain values for JSON."""

    code: str
    camera: str | None
    detail: str
    remedy: str
    detail_message: MessageDocument


@dataclass(frozen=True, slots=True)
class Fault:
    """Holds one fault: its code (a key of ``REMEDIES``), its camera (None for the whole rig), and the measurement."""

    code: str
    camera: str | None
    detail: Message

    @property
    def is_error(self) -> bool:
        """Returns whether the fault makes the capture fail. Any other fault is a warning."""
        return self.code not in WARNINGS

    @property
    def remedy(self) -> Message:
        """Returns a message that says what the operator should do about the fault."""
        return REMEDIES[self.code]

    def document(self) -> FaultDocument:
        """Returns the fault as plain values for JSON."""
        return {
            "code": self.code,
            "camera": self.camera,
            "detail": self.detail.text,
            "remedy": self.remedy.text,
            "detail_message": self.detail.document(),
        }

    def measured(self) -> Message:
        """Returns a message with the camera and the measurement."""
        return compose("fault-measured", camera=self.camera or "rig", measured=self.detail)

    def message(self) -> Message:
        """Returns one message with the camera, the fault, the measurement and the remedy."""
        camera = self.camera or "rig"
        return compose("fault-told", camera=camera, fault=self.code, measured=self.detail, remedy=self.remedy)

    def __str__(self) -> str:
        return self.message().text


def read_fault(document: Mapping[str, Any]) -> Fault:
    """Reads a fault from the result of ``Fault.document``. Earlier versions stored a fault's detail as a text."""
    return Fault(document["code"], document["camera"], read_message(document.get("detail_message", document["detail"])))


class ShotFailed(EigenheadError):
    """Reports a shot that is not usable as a capture. ``faults`` holds all faults of the shot."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__(compose("shot-failed", faults=[fault.message() for fault in self.faults]))


@dataclass(frozen=True, slots=True)
class CameraSync:
    """Holds the timing of one camera in a shot. ``skew_s`` is the delay (s) of the frame's arrival after its due time:
    the trigger time plus output delay and configured latency."""

    camera: str
    status: Status
    arrival_s: float | None  # after the trigger
    skew_s: float | None
    sequence: int | None


class CameraSyncDocument(TypedDict):
    """Holds the timing of one camera as plain values for JSON."""

    status: Status
    arrival_ms: float | None
    skew_ms: float | None
    frame: int | None


class SyncDocument(TypedDict):
    """Holds a ``SyncCertificate`` as plain values for JSON. Times are in milliseconds."""

    trigger_utc: str
    fired: bool
    uncertainty_ms: float | None
    skew_most_ms: float | None
    spread_ms: float | None
    cameras: dict[str, CameraSyncDocument]


class CheckDocument(TypedDict):
    """Holds the measurements of one picture as plain values for JSON."""

    mean: float
    clipped_share: float
    blur_px: float | None
    background_found: float | None
    background_moved_px: float | None


class ShotDocument(TypedDict):
    """Holds the content of ``shot.json`` (``eigenhead-shot/1``)."""

    format: str
    sync: SyncDocument
    checks: dict[str, CheckDocument]
    faults: list[FaultDocument]


@dataclass(frozen=True, slots=True)
class SyncCertificate:
    """Holds the timing of all pictures of a shot. ``trigger_s`` is the time of the trigger (time.monotonic, s), or None
    without a trigger."""

    trigger_s: float | None
    trigger_utc: str
    uncertainty_s: float
    skew_most_s: float
    cameras: tuple[CameraSync, ...]

    @property
    def spread_s(self) -> float | None:
        """Returns the time (s) from the earliest to the latest picture, or None if fewer than two pictures arrived."""
        skews = [camera.skew_s for camera in self.cameras if camera.skew_s is not None]
        return max(skews) - min(skews) if len(skews) > 1 else None

    def lines(self) -> list[str]:
        """Returns one line of text for each camera, with its name, status and skew."""
        width = max(len(line.camera) for line in self.cameras)
        skews = {line.camera: "" if line.skew_s is None else f"  {line.skew_s * 1000:+.1f} ms" for line in self.cameras}
        return [f"{line.camera:<{width}}  {line.status}{skews[line.camera]}" for line in self.cameras]

    def document(self) -> SyncDocument:
        """Returns the certificate as plain values for JSON. Times are in milliseconds."""
        return {
            "trigger_utc": self.trigger_utc,
            "fired": self.trigger_s is not None,
            "uncertainty_ms": _ms(self.uncertainty_s),
            "skew_most_ms": _ms(self.skew_most_s),
            "spread_ms": _ms(self.spread_s),
            "cameras": {
                c.camera: {
                    "status": c.status,
                    "arrival_ms": _ms(c.arrival_s),
                    "skew_ms": _ms(c.skew_s),
                    "frame": c.sequence,
                }
                for c in self.cameras
            },
        }


@dataclass(frozen=True, slots=True)
class PictureCheck:
    """Holds the measurements of one picture. ``registration`` is None for a black picture or without a clean plate."""

    exposure: Exposure
    blur_px: float | None
    registration: Registration | None

    def document(self) -> CheckDocument:
        """Returns the measurements as plain values for JSON."""
        registration = self.registration
        return {
            "mean": round(self.exposure.mean, 2),
            "clipped_share": round(self.exposure.clipped_share, 5),
            "blur_px": None if self.blur_px is None else round(self.blur_px, 2),
            "background_found": None if registration is None else round(registration.found, 3),
            "background_moved_px": None if registration is None else round(registration.moved_px, 2),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """Holds the result of one shot: pictures, the certificate of their timing, measurements and faults."""

    images: Mapping[str, ImageRgb]
    certificate: SyncCertificate
    checks: Mapping[str, PictureCheck]
    faults: tuple[Fault, ...]

    @property
    def complete(self) -> bool:
        """Returns whether the shot can be reconstructed, because all its faults are only warnings."""
        return not any(fault.is_error for fault in self.faults)

    def document(self) -> ShotDocument:
        """Returns the content of the file shot.json in a capture folder."""
        return {
            "format": "eigenhead-shot/1",
            "sync": self.certificate.document(),
            "checks": {name: check.document() for name, check in self.checks.items()},
            "faults": [fault.document() for fault in self.faults],
        }


@dataclass(frozen=True, slots=True)
class Timing:
    """Holds the time (time.monotonic, s) at which one camera's frame was due, and the period of its live view (s).

    ``triggered``: whether an output of the trigger box starts the exposure, or else the next frame to arrive is used.
    ``recorded``: whether the picture comes from a recording, so that its time is meaningless.
    """

    due_s: float
    period_s: float | None
    triggered: bool = True
    recorded: bool = False


def certify(
    frames: Mapping[str, Frame | None],
    timings: Mapping[str, Timing],
    *,
    trigger_s: float | None,
    trigger_utc: str,
    uncertainty_s: float,
    skew_most_s: float,
) -> tuple[SyncCertificate, list[Fault]]:
    """Returns the certificate of a shot, and its timing faults "late-trigger", "late" and "dropped". The keys of
    ``frames`` and ``timings`` are cameras."""
    skews = {name: frame.time_s - timings[name].due_s for name, frame in frames.items() if frame is not None}
    if trigger_s is None:
        skews = {}
    of_outputs = [skew_s for name, skew_s in skews.items() if timings[name].triggered]
    common_s = median(of_outputs) if len(of_outputs) >= 3 else 0.0
    faults: list[Fault] = []
    if common_s > skew_most_s:
        faults.append(Fault("late-trigger", None, compose("frames-late", late_ms=common_s * 1000)))
    else:
        common_s = 0.0
    lines = []
    for name, frame in frames.items():
        timing = timings[name]
        status = _status(frame, skews.get(name), common_s if timing.triggered else 0.0, timing, skew_most_s)
        if status in ("late", "dropped"):
            faults.append(Fault(status, name, _lateness(status, skews[name], timing)))
        arrival_s = None if frame is None or trigger_s is None else frame.time_s - trigger_s
        lines.append(CameraSync(name, status, arrival_s, skews.get(name), None if frame is None else frame.sequence))
    return SyncCertificate(trigger_s, trigger_utc, uncertainty_s, skew_most_s, tuple(lines)), faults


def _status(frame: Frame | None, skew_s: float | None, common_s: float, timing: Timing, most_s: float) -> Status:
    if frame is None:
        return "missing"
    if timing.recorded:
        return "recorded"
    if skew_s is None or skew_s - common_s <= most_s:
        return "in sync"
    lost = timing.triggered and timing.period_s is not None and skew_s - common_s >= DROPPED_PERIODS * timing.period_s
    return "dropped" if lost else "late"


def _lateness(status: Status, skew_s: float, timing: Timing) -> Message:
    if status == "dropped":
        return compose("frame-lost", late_ms=skew_s * 1000)
    return compose("frame-late" if timing.triggered else "free-frame-late", late_ms=skew_s * 1000)


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds * 1000, 3)

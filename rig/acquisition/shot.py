"""What a shot delivers: pictures, a certificate of how far they belong to one moment, and every fault by its name.

The judgement is made here, by pure functions of frames, clean plates and settings; rig.acquisition.session does the
shooting.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from statistics import median
from typing import Literal, TypedDict

import numpy as np
from jaxtyping import UInt8

from rig.acquisition.image_checks import Exposure, Registration, blur_px, exposure, register
from rig.acquisition.plates import Plates
from rig.drivers.base import Frame
from rig.errors import EigenheadError
from rig.formats.rig_toml import ShotConfig

ImageRgb = UInt8[np.ndarray, "h w 3"]
Status = Literal["in sync", "late", "dropped", "missing", "recorded"]

FAULTS = {
    "trigger": "the trigger box cannot be used",
    "late-trigger": "the outputs of the trigger box rose late",
    "missing": "the camera delivered no picture",
    "dropped": "the camera's triggered frame got lost",
    "late": "the camera's frame came late",
    "frozen": "the camera sends the same picture again and again",
    "size": "the picture has not the size of the calibration",
    "lights-off": "every picture is dark",
    "dark": "the camera's picture is dark",
    "swapped": "the camera shows what another one should",
    "view": "the camera does not see what its clean plates show",
    "moved": "the camera moved since its clean plates",
    "overexposed": "much of the picture is burnt out",
    "blurred": "the picture is out of focus",
    "setting": "the camera did not take a setting of rig.toml",
    "plates": "there are no clean plates of the camera",
    "disturbed": "something moved while the clean plates were taken",
    "occupied": "somebody or something stands where the clean plates before show nothing",
}
WARNINGS = frozenset({"moved", "overexposed", "blurred", "setting", "plates"})
"""Faults with which a capture is still worth reconstructing; the others end it."""

LEVEL_WITHOUT_PLATES = 64.0  # a studio picture's mean, where there is no plate to compare with
BLACK_LEVEL = 0.02  # of the plate's brightness: nothing can be seen in it
# Measured on two rendered captures of eleven cameras: own background 0.35 to 0.75 (lamps off: 0.12 to 0.5), another
# camera's up to 0.07. Between the two bounds the plates of the other cameras are asked.
FOUND_LEAST, FOUND_SURELY = 0.1, 0.25
MOVED_DARK_PX = 3.0  # the same with the lamps off: up to 2.6 px without any movement
DROPPED_PERIODS = 0.8


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: a code of ``FAULTS``, the camera (None: the rig), and what was measured."""

    code: str
    camera: str | None
    detail: str

    @property
    def is_error(self) -> bool:
        """Whether it ends the capture."""
        return self.code not in WARNINGS

    def __str__(self) -> str:
        return f"{self.camera or 'rig'}: {self.code}: {self.detail}"


class ShotFailed(EigenheadError):
    """A shot that is no capture; ``faults`` names everything that was found."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("the shot failed: " + "; ".join(map(str, self.faults)))


@dataclass(frozen=True, slots=True)
class CameraSync:
    """One camera's line of the certificate. ``skew_s``: arrival less trigger, output delay and configured latency."""

    camera: str
    status: Status
    arrival_s: float | None  # after the trigger
    skew_s: float | None
    sequence: int | None


class CameraSyncDocument(TypedDict):
    status: Status
    arrival_ms: float | None
    skew_ms: float | None
    frame: int | None


class SyncDocument(TypedDict):
    """A certificate in JSON; times in milliseconds."""

    trigger_utc: str
    fired: bool
    uncertainty_ms: float | None
    skew_most_ms: float | None
    spread_ms: float | None
    cameras: dict[str, CameraSyncDocument]


class CheckDocument(TypedDict):
    mean: float
    clipped_share: float
    blur_px: float | None
    background_found: float | None
    background_moved_px: float | None


class FaultDocument(TypedDict):
    code: str
    camera: str | None
    detail: str


class ShotDocument(TypedDict):
    """``shot.json`` (``eigenhead-shot/1``)."""

    format: str
    sync: SyncDocument
    checks: dict[str, CheckDocument]
    faults: list[FaultDocument]


@dataclass(frozen=True, slots=True)
class SyncCertificate:
    """How far the pictures of a shot belong to one moment. ``trigger_s`` is time.monotonic; None: nothing fired."""

    trigger_s: float | None
    trigger_utc: str
    uncertainty_s: float
    skew_most_s: float
    cameras: tuple[CameraSync, ...]

    @property
    def spread_s(self) -> float | None:
        """Largest less smallest skew; None where fewer than two frames came."""
        skews = [camera.skew_s for camera in self.cameras if camera.skew_s is not None]
        return max(skews) - min(skews) if len(skews) > 1 else None

    def lines(self) -> list[str]:
        """One a camera, for people."""
        width = max(len(line.camera) for line in self.cameras)
        skews = {line.camera: "" if line.skew_s is None else f"  {line.skew_s * 1000:+.1f} ms" for line in self.cameras}
        return [f"{line.camera:<{width}}  {line.status}{skews[line.camera]}" for line in self.cameras]

    def document(self) -> SyncDocument:
        """For JSON; times in milliseconds."""
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
    """What was measured on one picture; ``registration`` is None without a clean plate, or in a black picture."""

    exposure: Exposure
    blur_px: float | None
    registration: Registration | None


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """Everything that one release of the rig gave."""

    images: Mapping[str, ImageRgb]
    certificate: SyncCertificate
    checks: Mapping[str, PictureCheck]
    faults: tuple[Fault, ...]

    @property
    def complete(self) -> bool:
        """Whether it is worth reconstructing: every camera's picture, of one moment, of its own view."""
        return not any(fault.is_error for fault in self.faults)

    def document(self) -> ShotDocument:
        """For shot.json in the capture folder."""
        return {
            "format": "eigenhead-shot/1",
            "sync": self.certificate.document(),
            "checks": {name: _check_document(check) for name, check in self.checks.items()},
            "faults": [{"code": f.code, "camera": f.camera, "detail": f.detail} for f in self.faults],
        }


@dataclass(frozen=True, slots=True)
class Timing:
    """What the session knows of one camera's timing (s): when its frame was due, and how often it runs by itself.

    ``triggered``: the box's output makes the frame; otherwise the next one counts, whenever it comes. A recorded
    picture belongs to no moment of today.
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
    """The certificate, and the faults of time in it: "late-trigger", "late" and "dropped"."""
    skews = {name: frame.time_s - timings[name].due_s for name, frame in frames.items() if frame is not None}
    if trigger_s is None:
        skews = {}
    of_outputs = [skew_s for name, skew_s in skews.items() if timings[name].triggered]
    common_s = median(of_outputs) if len(of_outputs) >= 3 else 0.0
    faults: list[Fault] = []
    if common_s > skew_most_s:
        faults.append(Fault("late-trigger", None, f"frames came {common_s * 1000:.0f} ms after the release"))
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


def _lateness(status: Status, skew_s: float, timing: Timing) -> str:
    after = f"came {skew_s * 1000:.0f} ms after it was due"
    if status == "dropped":
        return f"no frame of the release, the next one {after}"
    return f"its frame {after}" if timing.triggered else f"it runs freely, and its next frame {after}: raise its fps"


def examine(images: Mapping[str, ImageRgb], plates: Plates) -> dict[str, PictureCheck]:
    """Measures every picture, in parallel: OpenCV lets go of the interpreter."""

    def one(name: str) -> PictureCheck:
        image = images[name]
        light = exposure(image)
        plate = plates.first.get(name)
        black = light.mean < BLACK_LEVEL * _level(name, plates)
        return PictureCheck(light, blur_px(image), None if plate is None or black else register(image, plate))

    with ThreadPoolExecutor(4) as pool:
        return dict(zip(images, pool.map(one, images), strict=True))


def judge(
    images: Mapping[str, ImageRgb], checks: Mapping[str, PictureCheck], plates: Plates, shot: ShotConfig
) -> list[Fault]:
    """The faults that can be seen in the pictures: of light, of focus, and of what the cameras look at."""
    light, lit = _light_faults(checks, plates, shot)
    faults = [*light]
    for name, check in checks.items():
        if check.exposure.clipped_share > shot.clipped_most:
            share = check.exposure.clipped_share * 100
            faults.append(
                Fault("overexposed", name, f"{share:.1f} % of the picture is burnt out: close the iris or shorten")
            )
        if lit[name] and check.blur_px is not None and check.blur_px > shot.blur_most_px:
            faults.append(
                Fault("blurred", name, f"edges are {check.blur_px:.1f} px wide, {shot.blur_most_px:g} px allowed")
            )
        if check.registration is not None:
            faults.extend(_view_faults(name, images, check.registration, lit[name], plates, shot))
    return faults


def _light_faults(
    checks: Mapping[str, PictureCheck], plates: Plates, shot: ShotConfig
) -> tuple[list[Fault], dict[str, bool]]:
    """Faults of light, and which cameras have enough of it."""
    ratios = {name: check.exposure.mean / _level(name, plates) for name, check in checks.items()}
    common = median(ratios.values()) if len(ratios) >= 3 else 1.0
    faults: list[Fault] = []
    if common < shot.dark_below:
        faults.append(Fault("lights-off", None, f"the pictures have {common * 100:.0f} % of their usual brightness"))
    for name, ratio in ratios.items():
        if ratio < shot.dark_below * min(1.0, common):
            of = "the other cameras' share" if common < shot.dark_below else "its usual brightness"
            faults.append(
                Fault("dark", name, f"{ratio / min(1.0, common) * 100:.0f} % of {of}: lens cap, iris or exposure")
            )
    return faults, {name: ratio >= shot.dark_below for name, ratio in ratios.items()}


def _view_faults(
    name: str, images: Mapping[str, ImageRgb], found: Registration, lit: bool, plates: Plates, shot: ShotConfig
) -> list[Fault]:
    if not found.conclusive:
        return []
    if found.found < (FOUND_SURELY if lit else FOUND_LEAST):
        other = _whose_view(name, images[name], found, plates)
        if other is not None or found.found < FOUND_LEAST:
            return [_wrong_view(name, other)]
    most_px = shot.moved_most_px if lit else max(shot.moved_most_px, MOVED_DARK_PX)
    if found.moved_px > most_px:
        detail = f"its background lies {found.moved_px:.1f} px from its clean plates: calibrate again, or put it back"
        return [Fault("moved", name, detail)]
    return []


def _whose_view(name: str, image: ImageRgb, own: Registration, plates: Plates) -> str | None:
    """The camera whose clean plate fits the picture far better than the own one does."""
    others = {other: register(image, plate).found for other, plate in plates.first.items() if other != name}
    best = max(others, key=lambda other: others[other], default=None)
    return best if best is not None and others[best] >= max(FOUND_LEAST, 2 * own.found) else None


def _wrong_view(name: str, other: str | None) -> Fault:
    if other is not None:
        return Fault("swapped", name, f"it shows the view of {other}: their cables or identities are swapped")
    return Fault(
        "view", name, "its background is not that of its clean plates: was it moved? Put it back or take new plates"
    )


def _level(name: str, plates: Plates) -> float:
    plate = plates.first.get(name)
    return LEVEL_WITHOUT_PLATES if plate is None else max(float(plate[::4, ::4].mean()), 1.0)


def _check_document(check: PictureCheck) -> CheckDocument:
    registration = check.registration
    return {
        "mean": round(check.exposure.mean, 2),
        "clipped_share": round(check.exposure.clipped_share, 5),
        "blur_px": None if check.blur_px is None else round(check.blur_px, 2),
        "background_found": None if registration is None else round(registration.found, 3),
        "background_moved_px": None if registration is None else round(registration.moved_px, 2),
    }


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds * 1000, 3)

"""Reads rig.toml: the cameras, trigger box and lights of a rig, and the limits for a shot.

Every table of the file has a frozen dataclass whose fields are the keys. An unknown key of rig.toml is a fault, and the
message suggests the most similar known key. A camera is identified by its serial number, its address or a path in
/dev/v4l/by-id or by-path, never by an index, because indices change at a reboot. See deploy/rig.example.toml."""

import dataclasses
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rig.errors import InputError
from rig.formats.cameras.cameras_json import name_fault
from rig.formats.captures.shot_files import PLATES_MOST
from rig.messages.message import Message, compose
from rig.text import suggest
from rig.typed_tables import read_fields

FORMAT = "eigenhead-rig/1"
DriverName = Literal["opencv", "gphoto", "genicam", "node", "replay", "simulated"]
TriggerMode = Literal["external", "software", "free"]

# The kernel numbers devices in the order of discovery, so numbers change with a reboot or another port.
_INDEXED_CAMERA = re.compile(r"\d{1,2}|/dev/video\d+|usb:\d+,\d+|(fake_?|cam(era)?)?#\d+", re.IGNORECASE)
_INDEXED_PORT = re.compile(r"\d{1,2}|/dev/tty(USB|ACM|S)\d+|COM\d+", re.IGNORECASE)

_CAMERA_BOUNDS = {
    "delay_us": (0, 500_000),
    "latency_ms": (0, 60_000),
    "width": (1, 65_536),
    "height": (1, 65_536),
    "fps": (0.01, 1000),
    "exposure_ms": (0.001, 60_000),
    "gain_db": (-60, 60),
    "white_balance_k": (1000, 20_000),
}

_TRIGGER_BOUNDS = {"pulse_us": (1, 500_000), "baud": (300, 4_000_000), "window_s": (0.1, 60)}
_SHOT_BOUNDS = {
    "timeout_s": (0.001, 600),
    "open_timeout_s": (0.001, 600),
    "warm_up_frames": (1, 1000),
    "plates": (1, PLATES_MOST),
    "plates_over_s": (0, 600),
    "skew_most_ms": (0.001, 60_000),
    "clipped_most": (1e-6, 1),
    "dark_below": (1e-6, 100),
    "blur_most_px": (0.001, 1000),
    "moved_most_px": (0.001, 1000),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig:
    """Holds one table [[cameras]] of rig.toml. The program keeps omitted settings of the camera."""

    name: str  # as in cameras.json
    driver: DriverName
    identity: str  # its serial number, device path or address
    trigger: TriggerMode = "external"  # external: the box's output; software: a command; free: not synchronised
    channel: int | None = None  # output of the trigger box
    delay_us: int = 0  # of that output
    latency_ms: float = 0.0  # from exposure to arrival: readout and transport, by `rig check`
    pixel_format: str | None = None  # by the camera's own name, such as BayerRG8
    width: int | None = None  # of the picture, px
    height: int | None = None  # of the picture, px
    fps: float | None = None  # frames a second of the live view, or of a camera that runs free
    exposure_ms: float | None = None  # open shutter
    gain_db: float | None = None  # of the sensor's amplifier
    white_balance_k: int | None = None  # colour temperature of the light
    rotation_deg: Literal[0, 90, 180, 270] = 0  # clockwise, of the picture, to stand upright

    def exposure_settings(self) -> list[str]:
        """Returns the names of those settings of exposure, gain and white balance that have a value."""
        return [key for key in ("exposure_ms", "gain_db", "white_balance_k") if getattr(self, key) is not None]


@dataclass(frozen=True, slots=True, kw_only=True)
class TriggerConfig:
    """Holds the table [trigger] of rig.toml, for the box that releases all cameras. ``port`` is a path in
    /dev/serial/by-id or a udev link."""

    port: str  # serial port of the box
    baud: int = 115200  # bits a second on the port
    pulse_us: int = 1000  # length of the trigger pulse
    window_s: float = 5.0  # the box disarms itself after it


@dataclass(frozen=True, slots=True, kw_only=True)
class LightsConfig:
    """Holds the table [lights] of rig.toml: light outputs of the trigger box that are on during a shot."""

    outputs: tuple[int, ...] = ()  # numbers on the box
    settle_s: float = 0.3  # halogen and LED drivers reach their level well within it
    keep_on: bool = False  # after the session


@dataclass(frozen=True, slots=True, kw_only=True)
class ShotConfig:
    """Holds the table [shot] of rig.toml: waiting times, and limits that decide whether a shot is faulty."""

    timeout_s: float = 2.0  # from the trigger until a camera's frame must be there
    open_timeout_s: float = 10.0  # until a camera must be open
    warm_up_frames: int = 3  # frames dropped after a camera is opened
    plates: int = 5  # clean plates taken of each camera
    plates_over_s: float = 3.0  # from the first clean plate to the last: in that time a person who sits still moves
    skew_most_ms: float = 40.0  # in which a head that drifts at 25 mm/s moves 1 mm
    clipped_most: float = 0.05  # share of pixels at 255 in every channel
    dark_below: float = 0.25  # brightness relative to the clean plates
    blur_most_px: float = 2.5  # standard deviation of the edge spread
    moved_most_px: float = 1.0  # of the background against the clean plates


@dataclass(frozen=True, slots=True, kw_only=True)
class RigConfig:
    """Holds a whole rig.toml. Relative paths in rig.toml start from ``folder``, the file's folder."""

    format: Literal["eigenhead-rig/1"]
    cameras: tuple[CameraConfig, ...]
    name: str = "rig"  # shown in pages and reports
    calibration: str | None = None  # cameras.json
    plates: str = "plates"  # folder of the clean plates
    front: str | None = None  # the camera that the subject faces
    trigger: TriggerConfig | None = None
    lights: LightsConfig = LightsConfig()
    shot: ShotConfig = ShotConfig()
    folder: Path = dataclasses.field(default=Path(), metadata={"key": False})

    @property
    def plates_folder(self) -> Path:
        """Returns the folder of the clean plates (pictures of the empty studio)."""
        return self.folder / self.plates

    @property
    def calibration_file(self) -> Path | None:
        """Returns the path of the rig's calibration, or None if rig.toml names none."""
        return None if self.calibration is None else self.folder / self.calibration

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the cameras' names in the order of the file."""
        return tuple(camera.name for camera in self.cameras)


def read_rig_config(path: Path) -> RigConfig:
    """Reads rig.toml. Raises an InputError that names every fault."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(str(path), [compose("no-rig-toml", reason=str(error.strerror))]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(path.name, [compose("no-toml", reason=str(error))]) from error
    return rig_config_from_document(document, path.parent, path.name)


def rig_config_from_document(document: Mapping[str, Any], folder: Path, subject: str = "rig.toml") -> RigConfig:
    """Converts the content of rig.toml to a RigConfig. Raises an InputError that names every fault."""
    faults: list[Message] = []
    config = read_fields(RigConfig, document, "", faults)
    if faults := faults or _rig_faults(config):
        raise InputError(subject, faults)
    return dataclasses.replace(config, folder=folder)


def adjusted(
    config: RigConfig, cameras: Mapping[str, Mapping[str, float | None]], outputs: tuple[int, ...] | None
) -> RigConfig:
    """Returns the rig's configuration with changed camera settings (``exposure_ms``, ``gain_db``, ``white_balance_k``)
    and lamps.

    ``outputs``: the trigger box's outputs that switch lamps; None keeps those of rig.toml. Raises
    InputError naming every fault."""
    changed = dataclasses.replace(
        config,
        cameras=tuple(dataclasses.replace(camera, **cameras.get(camera.name, {})) for camera in config.cameras),
        lights=config.lights if outputs is None else dataclasses.replace(config.lights, outputs=outputs),
    )
    faults = _rig_faults(changed)
    if faults:
        raise InputError("rig", faults)
    return changed


def _rig_faults(config: RigConfig) -> list[Message]:
    faults: list[Message] = []
    if not config.cameras:
        faults.append(compose("rig-without-cameras"))
    if config.front is not None and config.front not in config.names:
        faults.append(_hinted(compose("front-unknown", camera=f"{config.front!r}"), config.front, config.names))
    for what in ("name", "identity", "channel"):
        faults.extend(_doubles(config, what))
    for camera in config.cameras:
        of_camera = _camera_faults(camera, config.trigger)
        faults.extend(compose("located", where=f"cameras.{camera.name}", fault=fault) for fault in of_camera)
    if config.trigger is not None:
        of_trigger = _trigger_faults(config.trigger)
        faults.extend(compose("located", where="trigger", fault=fault) for fault in of_trigger)
    strange = [output for output in config.lights.outputs if output not in range(4)]
    faults.extend(compose("lights-output-unknown", output=output) for output in strange)
    faults += _outside(config.lights, {"settle_s": (0, 60)}, "lights.")
    return faults + _outside(config.shot, _SHOT_BOUNDS, "shot.")


def _doubles(config: RigConfig, what: str) -> list[Message]:
    users: dict[Any, list[str]] = {}
    for camera in config.cameras:
        if what == "identity" and camera.driver in ("replay", "simulated"):
            continue  # one file holds all of them
        users.setdefault(getattr(camera, what), []).append(camera.name)
    return [
        compose("used-by-several", what=what, value=f"{value!r}", users=len(names), cameras=names)
        for value, names in users.items()
        if len(names) > 1 and value is not None
    ]


def _camera_faults(camera: CameraConfig, trigger: TriggerConfig | None) -> list[Message]:
    faults: list[Message] = []
    fault = name_fault(camera.name)
    if fault:
        faults.append(compose("located", where="name", fault=fault))
    if not camera.identity.strip():
        faults.append(compose("identity-empty"))
    if _INDEXED_CAMERA.fullmatch(camera.identity.strip()):
        faults.append(compose("identity-by-index", identity=f"{camera.identity!r}"))
    if camera.channel is not None and camera.channel not in range(12):
        faults.append(compose("channel-unknown", channel=camera.channel))
    if camera.channel is not None and trigger is None:
        faults.append(compose("channel-without-trigger"))
    return faults + _outside(camera, _CAMERA_BOUNDS)


def _trigger_faults(trigger: TriggerConfig) -> list[Message]:
    faults: list[Message] = []
    if _INDEXED_PORT.fullmatch(trigger.port.strip()):
        faults.append(compose("port-by-index", port=f"{trigger.port!r}"))
    return faults + _outside(trigger, _TRIGGER_BOUNDS)


def _outside(table: object, bounds: Mapping[str, tuple[float, float]], where: str = "") -> list[Message]:
    """Returns a fault for each value of a table that lies outside its bounds."""
    values = {key: getattr(table, key) for key in bounds}
    return [
        compose("value-outside", key=where + key, value=f"{value}", least=f"{bounds[key][0]}", most=f"{bounds[key][1]}")
        for key, value in values.items()
        if value is not None and not bounds[key][0] <= value <= bounds[key][1]
    ]


def _hinted(fault: Message, word: Any, known: Iterable[Any]) -> Message:
    """Adds to a fault the word of ``known`` that is most similar to ``word``, if any is similar."""
    near = suggest(str(word), map(str, known), min_likeness=0.5)
    return compose("did-you-mean", fault=fault, nearest=f"{near[0]!r}") if near else fault

"""Defines the interface of camera drivers and their errors, and finds the driver that rig.toml names for a camera. The
driver's module, and with it any vendor's library, is imported only then.

``grab`` waits for the camera's next frame and returns when it arrived; ``retrieve`` decodes that frame. They are two
calls because most frames of a stream are never used, and decoding them all would make the arrival times late.
A driver belongs to one thread at a time (``rig.drivers.feed``).
"""

import importlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from rig.errors import EigenheadError
from rig.formats.rig_toml import CameraConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose


@dataclass(frozen=True, slots=True)
class Arrival:
    """Holds when a frame arrived (time.monotonic, s; the earliest moment known to the driver) and the frame's running
    number."""

    time_s: float
    sequence: int


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Holds one picture, RGB and upright, with the time of its arrival (time.monotonic, s) and its running number."""

    image: ImageRgb
    time_s: float
    sequence: int


@runtime_checkable
class Driver(Protocol):
    """Describes the driver of one camera. Every method but ``close`` may raise DriverError; ``close`` raises nothing
    and may be called twice."""

    live: bool
    """Its pictures come from a sensor, so that two equal ones mean a frozen stream."""

    def open(self, timeout_s: float) -> None:
        """Finds the camera with the identity in rig.toml, and starts it. Raises CameraNotFound."""
        ...

    def configure(self) -> tuple[Message, ...]:
        """Applies the settings of rig.toml. Returns one message for each setting that the camera refused."""
        ...

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next frame and returns when it arrived. Raises GrabTimeout, after which ``grab`` may be called
        again, and CameraLost.

        It may take a second longer than ``timeout_s`` if the vendor's library has no such timeout.
        """
        ...

    def retrieve(self) -> ImageRgb:
        """Decodes the frame of the last ``grab`` and returns it as the camera sees it (not rotated)."""
        ...

    def trigger(self) -> None:
        """Asks the camera for a picture now, if its ``trigger`` in rig.toml is "software". Other cameras ignore it."""
        return

    def close(self) -> None:
        """Releases the camera."""
        ...


class DriverError(EigenheadError):
    """Reports that a camera does not do what it should. The message begins with the camera's name."""

    def __init__(self, camera: str, message: Message) -> None:
        self.camera = camera
        super().__init__(compose("located", where=camera, fault=message))


class CameraNotFound(DriverError):
    """Reports that no camera has the identity that rig.toml names."""

    def __init__(self, camera: CameraConfig, why: Message | str) -> None:
        super().__init__(camera.name, compose("camera-not-found", identity=f"{camera.identity!r}", reason=why))


class CameraLost(DriverError):
    """Reports that a camera was disconnected, or that what it sends is no picture."""

    def __init__(self, camera: CameraConfig, why: Message | str) -> None:
        super().__init__(camera.name, compose("camera-lost", reason=why))


class GrabTimeout(DriverError):
    """Reports that no frame arrived in time. The camera may still work."""

    def __init__(self, camera: CameraConfig, timeout_s: float) -> None:
        super().__init__(camera.name, compose("no-frame-within", seconds=timeout_s))


class DriverMissing(DriverError):
    """Reports that the vendor's library is not installed."""

    def __init__(self, camera: CameraConfig, needs: Message | str) -> None:
        super().__init__(camera.name, compose("driver-needs", driver=f"{camera.driver!r}", needs=needs))


def upright(image: ImageRgb, rotation_deg: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Returns the picture turned clockwise by ``rotation_deg``, a multiple of 90 degrees."""
    return np.ascontiguousarray(np.rot90(image, -rotation_deg // 90)) if rotation_deg else image


@runtime_checkable
class _DriverModule(Protocol):
    def make(self, camera: CameraConfig, folder: Path) -> Driver: ...


def driver_for(camera: CameraConfig, folder: Path) -> Driver:
    """Returns the driver that rig.toml names for a camera, not yet opened. ``folder`` is the folder of rig.toml. Raises
    DriverMissing."""
    module = cast(_DriverModule, importlib.import_module(f".{camera.driver}", __package__))
    return module.make(camera, folder)


class Pace:
    """Ticks ``fps`` times a second from its creation on. Ticks that nobody waited for are lost, like frames of a
    camera."""

    def __init__(self, fps: float) -> None:
        self._period_s = 1.0 / fps
        self._started_s = time.monotonic()
        self.beat = 0

    def wait(self, timeout_s: float) -> bool:
        """Sleeps until the next tick, or for ``timeout_s``. Tells whether there was a tick."""
        passed = int((time.monotonic() - self._started_s) / self._period_s)
        due = max(self.beat + 1, passed)
        wait_s = self._started_s + due * self._period_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return False
        time.sleep(max(0.0, wait_s))
        self.beat = due
        return True


class PacedDriver(Driver):
    """Delivers frames at the camera's rate without a device."""

    def __init__(self, camera: CameraConfig) -> None:
        self._camera = camera
        self._pace: Pace | None = None

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next frame at the camera's rate. Raises GrabTimeout, CameraLost."""
        if self._pace is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        if not self._pace.wait(timeout_s):
            raise GrabTimeout(self._camera, timeout_s)
        return Arrival(time.monotonic(), self._pace.beat)

"""Defines the interface and the errors of camera drivers, and creates the driver that rig.toml names for a camera. A
driver's module, with its vendor's library, is imported only if rig.toml names this driver.

``grab`` waits for the camera's next frame and returns its time of arrival; ``retrieve`` decodes the frame. The two
calls are separate because most frames are never used, and decoding every frame would delay the measured times. Only one
thread at a time may use a driver (``rig.drivers.feed``).
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
    """Holds the earliest known time of arrival of a frame (time.monotonic, s), and the frame's sequence number."""

    time_s: float
    sequence: int


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Holds one upright RGB picture with its time of arrival (time.monotonic, s) and its sequence number."""

    image: ImageRgb
    time_s: float
    sequence: int


@runtime_checkable
class Driver(Protocol):
    """Declares the methods of a driver for one camera. Every method but ``close`` may raise DriverError; ``close`` may
    be called twice."""

    live: bool
    """Its pictures come from a sensor, so that two equal ones mean a frozen stream."""

    def open(self, timeout_s: float) -> None:
        """Finds and starts the camera with the identity in rig.toml. Raises CameraNotFound."""
        ...

    def configure(self) -> tuple[Message, ...]:
        """Applies the settings of rig.toml. Returns one message for each setting that the camera refused."""
        ...

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next frame and returns its time of arrival. Raises CameraLost for a lost camera, and
        GrabTimeout, after which ``grab`` may be called again.

        The call may take a second longer than ``timeout_s`` if the vendor's library has no timeout.
        """
        ...

    def retrieve(self) -> ImageRgb:
        """Decodes the frame of the last ``grab`` and returns it without the rotation of rig.toml."""
        ...

    def trigger(self) -> None:
        """Makes the camera take a picture, but only if its ``trigger`` in rig.toml is "software"."""
        return

    def close(self) -> None:
        """Stops the camera and frees its resources."""
        ...


class DriverError(EigenheadError):
    """Reports a failure of a camera. The message begins with the camera's name."""

    def __init__(self, camera: str, message: Message) -> None:
        self.camera = camera
        super().__init__(compose("located", where=camera, fault=message))


class CameraNotFound(DriverError):
    """Reports that no camera has the identity that rig.toml names."""

    def __init__(self, camera: CameraConfig, why: Message | str) -> None:
        super().__init__(camera.name, compose("camera-not-found", identity=f"{camera.identity!r}", reason=why))


class CameraLost(DriverError):
    """Reports that a camera was disconnected or sends data that are no picture."""

    def __init__(self, camera: CameraConfig, why: Message | str) -> None:
        super().__init__(camera.name, compose("camera-lost", reason=why))


class GrabTimeout(DriverError):
    """Reports that no frame arrived in time, from a camera that may still work."""

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
    """Creates the driver that rig.toml names for a camera. ``folder`` is the folder of rig.toml. Raises
    DriverMissing."""
    module = cast(_DriverModule, importlib.import_module(f".{camera.driver}", __package__))
    return module.make(camera, folder)


class Pace:
    """Ticks ``fps`` times a second. A tick for which no call of ``wait`` waits is lost, like a camera's frame."""

    def __init__(self, fps: float) -> None:
        self._period_s = 1.0 / fps
        self._started_s = time.monotonic()
        self.beat = 0

    def wait(self, timeout_s: float) -> bool:
        """Sleeps until the next tick, or for ``timeout_s`` at most. Returns whether a tick occurred."""
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
    """Implements ``grab`` for drivers without a device, which deliver frames at a fixed rate."""

    def __init__(self, camera: CameraConfig) -> None:
        self._camera = camera
        self._pace: Pace | None = None

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next frame. Raises GrabTimeout and CameraLost."""
        if self._pace is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        if not self._pace.wait(timeout_s):
            raise GrabTimeout(self._camera, timeout_s)
        return Arrival(time.monotonic(), self._pace.beat)

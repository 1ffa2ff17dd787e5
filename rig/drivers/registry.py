"""Finds the driver that rig.toml names for a camera. Its module, and with it any vendor's library, is imported only
then."""

import importlib
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

from rig.drivers.base import Driver
from rig.formats.rig_toml import CameraConfig


@runtime_checkable
class _DriverModule(Protocol):
    def make(self, camera: CameraConfig, folder: Path) -> Driver: ...


def driver_for(camera: CameraConfig, folder: Path) -> Driver:
    """Returns the driver that rig.toml names for a camera, not yet opened. ``folder`` is the folder of rig.toml. Raises
    DriverMissing."""
    module = cast(_DriverModule, importlib.import_module(f".{camera.driver}", __package__))
    return module.make(camera, folder)

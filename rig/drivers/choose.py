"""The driver that rig.toml names for a camera; its module, and with it any vendor's package, is imported on use."""

import importlib
from pathlib import Path
from typing import Protocol, cast

from rig.config import CameraConfig
from rig.drivers.base import Driver


class _DriverModule(Protocol):
    def make(self, camera: CameraConfig, folder: Path) -> Driver: ...


def driver_for(camera: CameraConfig, folder: Path) -> Driver:
    """The camera's driver, not opened yet. ``folder`` is where rig.toml lies. Raises DriverMissing."""
    module = cast(_DriverModule, importlib.import_module(f"rig.drivers.{camera.driver}"))
    return module.make(camera, folder)

"""Drives a camera of the simulated studio inside this process, without network or trigger box.

``identity`` is a head's mesh file, relative to rig.toml, followed by # and the name of the studio's camera if it
differs. The head sits in the default studio, and each camera photographs it at its rate. ``rig.studio.devices.serve``
simulates cameras as separate devices with a trigger box.
"""

import time
from pathlib import Path

from rig.drivers.base import CameraLost, CameraNotFound, Driver, Pace, PacedDriver
from rig.errors import InputError
from rig.formats.rig_toml import CameraConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose
from rig.studio.devices.sources import ImageSource, SceneImages, scene_of_file

_FPS = 10.0


def make(camera: CameraConfig, folder: Path) -> Driver:
    """Returns the driver for a camera of the simulated studio with the head of a mesh file in it."""
    file, _, name = camera.identity.partition("#")
    return SimulatedDriver(camera, name or camera.name, mesh_file=folder / file)


class SimulatedDriver(PacedDriver):
    """Photographs an ``ImageSource`` or, if there is none, the simulated studio with the head of ``mesh_file`` in it.
    The studio is built when the driver is opened."""

    live = True

    def __init__(
        self, camera: CameraConfig, view: str, *, mesh_file: Path | None = None, source: ImageSource | None = None
    ) -> None:
        super().__init__(camera)
        self._view = view
        self._mesh_file = mesh_file
        self._source = source

    def open(self, timeout_s: float) -> None:
        """Builds the studio if needed, and starts the camera's rate. Raises CameraNotFound."""
        if self._source is None:
            self._source = self._build()
        self._pace = Pace(self._camera.fps or _FPS)

    def configure(self) -> tuple[Message, ...]:
        """Returns one message for each setting of exposure, gain or white balance in rig.toml, which a simulated camera
        lacks."""
        return tuple(compose("no-setting-of-simulated", setting=key) for key in self._camera.exposure_settings())

    def retrieve(self) -> ImageRgb:
        """Renders and returns the camera's current view. Raises CameraLost if it is not open."""
        if self._source is None or self._pace is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        return self._source(self._view, time.monotonic())

    def close(self) -> None:
        """Stops the camera but keeps the studio."""
        self._pace = None

    def _build(self) -> ImageSource:
        assert self._mesh_file is not None, "a source or a file"
        try:
            scene = scene_of_file(self._mesh_file)
        except InputError as error:
            raise CameraNotFound(self._camera, str(error)) from error
        if self._view not in scene.rig:
            raise CameraNotFound(self._camera, compose("studio-has", names=scene.rig.names))
        return SceneImages(scene, seated=True)

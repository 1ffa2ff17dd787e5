"""Simulates a camera of a studio inside this process, without network or trigger box.

In rig.toml, ``identity`` is the mesh file of a head, relative to rig.toml. If the camera has another name in the
studio, ``identity`` continues with ``#`` and that name. The simulated camera renders the head in the default studio at
the camera's frame rate. ``rig.studio.devices.serve`` instead simulates separate network cameras and a trigger box.
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
    """Creates the driver for a camera of a simulated studio that contains the head of a mesh file."""
    file, _, name = camera.identity.partition("#")
    return SimulatedDriver(camera, name or camera.name, mesh_file=folder / file)


class SimulatedDriver(PacedDriver):
    """Delivers pictures from an ``ImageSource`` or, without one, of a simulated studio with the head of ``mesh_file``.
    ``open`` builds the studio."""

    live = True

    def __init__(
        self, camera: CameraConfig, view: str, *, mesh_file: Path | None = None, source: ImageSource | None = None
    ) -> None:
        super().__init__(camera)
        self._view = view
        self._mesh_file = mesh_file
        self._source = source

    def open(self, timeout_s: float) -> None:
        """Builds the studio if needed, and starts the sequence of frames. Raises CameraNotFound."""
        if self._source is None:
            self._source = self._build()
        self._pace = Pace(self._camera.fps or _FPS)

    def configure(self) -> tuple[Message, ...]:
        """Returns one message for each setting of exposure, gain or white balance, which a simulated camera lacks."""
        return tuple(compose("no-setting-of-simulated", setting=key) for key in self._camera.exposure_settings())

    def retrieve(self) -> ImageRgb:
        """Renders and returns the camera's current view. Raises CameraLost if the camera is not open."""
        if self._source is None or self._pace is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        return self._source(self._view, time.monotonic())

    def close(self) -> None:
        """Stops the sequence of frames but keeps the studio."""
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

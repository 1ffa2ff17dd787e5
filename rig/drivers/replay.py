"""Replaces a camera by one picture from a recorded capture, delivered repeatedly at a fixed rate.

In rig.toml, ``identity`` is the capture's folder, relative to rig.toml. If the camera has another name in the capture,
``identity`` continues with ``#`` and that name. The setting ``plates = "FOLDER/background"`` adds the recorded clean
plates (pictures of the empty studio).
"""

from pathlib import Path

from rig.drivers.base import CameraLost, CameraNotFound, Driver, Pace, PacedDriver
from rig.errors import InputError
from rig.formats.pictures.images import IMAGE_SUFFIXES, read_image
from rig.formats.rig_toml import CameraConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose

_FPS = 10.0


def make(camera: CameraConfig, folder: Path) -> Driver:
    """Creates the driver for a camera of a recorded capture."""
    return ReplayDriver(camera, folder)


class ReplayDriver(PacedDriver):
    """Delivers one recorded picture repeatedly at a fixed rate."""

    live = False

    def __init__(self, camera: CameraConfig, folder: Path) -> None:
        super().__init__(camera)
        capture, _, recorded = camera.identity.partition("#")
        self._images = folder / capture / "images"
        self._recorded = recorded or camera.name
        self._image: ImageRgb | None = None

    def open(self, timeout_s: float) -> None:
        """Reads the camera's picture from the capture folder. Raises CameraNotFound."""
        paths = [self._images / (self._recorded + suffix) for suffix in IMAGE_SUFFIXES]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            raise CameraNotFound(
                self._camera, compose("no-recorded-picture", camera=self._recorded, folder=self._images.parent.name)
            )
        try:
            self._image = read_image(path)
        except InputError as error:
            raise CameraNotFound(self._camera, str(error)) from error
        self._pace = Pace(self._camera.fps or _FPS)

    def configure(self) -> tuple[Message, ...]:
        """Returns no message, because a recorded picture has no settings."""
        return ()

    def retrieve(self) -> ImageRgb:
        """Returns the recorded picture."""
        if self._image is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        return self._image

    def close(self) -> None:
        """Frees the recorded picture."""
        self._image = self._pace = None

"""Declares the methods that the service needs of a rig, and holds helpers that every rig uses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np

from rig.acquisition.plates import PlatesVersion
from rig.acquisition.shot import ShotDocument
from rig.image import ImageRgb
from rig.messages.message import Message, compose
from rig.rig import Rig
from server.errors import Conflict
from server.services.records import CameraOut, CameraSettingsOut, CleanPlates, RigOut
from server.tasks.simulate import SimulatedCertificate

SHOT_BYTES = 64 << 20  # that a shot may take on the disk
PREVIEW_WIDTH = 640  # pixels
PREVIEW_QUALITY = 80  # of JPEG, 0 to 100


class RigBackend(Protocol):
    """Declares what the service needs of a rig, simulated or real. Methods block, so call them from a thread."""

    def describe(self) -> RigOut:
        """Returns the state of the rig without opening its cameras."""
        ...

    def calibrated(self) -> Rig | None:
        """Returns the cameras as calibrated; None where they are not."""
        ...

    def capture(self, folder: Path, *, seed: int | None, board: bool = False) -> ShotDocument | SimulatedCertificate:
        """Takes a shot, writes the capture to ``folder/files`` and returns the shot's certificate.

        ``board``: the shot shows the calibration board, for which neither a calibration nor every camera is needed.
        ``seed`` chooses the subject of the simulated studio. Raises Unavailable naming what is missing, and InputError
        for a seed of a real rig.
        """
        ...

    def look(self) -> Mapping[str, ImageRgb]:
        """Returns a current picture of each camera, by name. Cameras that deliver none are left out. Raises Unavailable
        if the rig cannot be opened."""
        ...

    def preview(self, camera: str) -> bytes:
        """Returns a current picture of one camera as a JPEG file, at most ``PREVIEW_WIDTH`` pixels wide. Raises
        NotFound for an unknown camera, and Unavailable if the rig cannot be opened or the camera delivers none."""
        ...

    def camera_settings(self, camera: str) -> CameraSettingsOut:
        """Returns the exposure, gain and white balance requested of a camera. Raises NotFound for an unknown camera."""
        ...

    def set_camera(self, camera: str, changes: Mapping[str, float | None]) -> CameraSettingsOut:
        """Changes settings of a camera and keeps them across restarts; an open rig is closed and opened again. Raises
        NotFound for an unknown camera, InputError for wrong values, and Conflict for the simulated studio."""
        ...

    def lights(self) -> tuple[int, ...]:
        """Returns the numbers of the light outputs that are on during a shot."""
        ...

    def set_lights(self, outputs: tuple[int, ...]) -> tuple[int, ...]:
        """Chooses which light outputs are on during a shot, keeps that across restarts, and returns them. Raises
        InputError for wrong outputs, and Conflict for the simulated studio."""
        ...

    def take_background(self) -> CleanPlates:
        """Takes new clean plates of the empty studio and puts them to use. Raises Unavailable if cameras fail, and
        Conflict if the pictures show a person."""
        ...

    def plates(self) -> list[PlatesVersion]:
        """Returns the versions of clean plates, the one in use and earlier ones, newest first."""
        ...

    def use_plates(self, version: str) -> None:
        """Puts an earlier version of the clean plates to use again. Raises NotFound for an unknown version, and
        Unavailable."""
        ...

    def use(self, calibration: Path) -> None:
        """Uses the calibration in a cameras.json file from now on; the file is copied. Raises Conflict if its cameras
        are not those of the rig."""
        ...

    def close(self) -> None:
        """Closes the cameras, or the child process that simulates them."""
        ...


def check_names(rig: Rig, names: tuple[str, ...]) -> None:
    """Raises Conflict, naming the cameras that only one of both has, unless a calibration is of the cameras
    ``names``."""
    if set(rig.names) != set(names):
        differing = sorted(set(rig.names) ^ set(names))
        faults = [compose("camera-in-one-alone", camera=name) for name in differing]
        raise Conflict("other-rig", compose("calibration-of-other-rig"), faults)


def rig_state(
    identity: str,
    kind: Literal["simulated", "real"],
    cameras: list[CameraOut],
    faults: list[Message],
    calibration: str | None,
) -> RigOut:
    """Returns the state of a rig, which is ready if it has no fault and no camera is missing."""
    ready = not faults and all(camera.state != "missing" for camera in cameras)
    return RigOut(id=identity, kind=kind, ready=ready, cameras=cameras, faults=tuple(faults), calibration=calibration)


def jpeg(image: ImageRgb, width: int = PREVIEW_WIDTH) -> bytes:
    """Encodes an RGB image as a JPEG file. An image wider than ``width`` pixels is reduced to that width."""
    small = reduced(image, width)
    done, data = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, PREVIEW_QUALITY])
    assert done
    return data.tobytes()


def reduced(image: ImageRgb, width: int) -> ImageRgb:
    """Returns an image no wider than ``width`` pixels; its proportions stay. A smaller image is returned as it is."""
    if image.shape[1] <= width:
        return image
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)

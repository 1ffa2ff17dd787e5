"""What the service needs of a rig, and what every rig shares."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from rig.acquisition.plates import PlatesVersion
from rig.acquisition.shot import ShotDocument
from rig.image import ImageRgb
from rig.messages.message import Message, compose
from rig.rig import Rig
from server.errors import Conflict
from server.services.records import CameraSettings, CleanPlates, RigCamera, RigState
from server.tasks.simulate import SimulatedCertificate

SHOT_BYTES = 64 << 20  # that a shot may take on the disk


class RigBackend(Protocol):
    """Declares what the service needs of a rig. Methods block: call them from a thread."""

    def describe(self) -> RigState: ...

    def capture(self, folder: Path, *, seed: int | None, board: bool = False) -> ShotDocument | SimulatedCertificate:
        """Takes a shot into ``folder/files`` and returns its certificate. Raises Unavailable naming what is missing.

        ``board``: the shot shows the calibration board, for which neither a calibration nor every camera is needed.
        """
        ...

    def look(self) -> Mapping[str, ImageRgb]:
        """Returns what each camera sees now; cameras that show nothing are left out. Raises Unavailable."""
        ...

    def preview(self, camera: str) -> bytes:
        """Returns a JPEG file of what a camera sees now. Raises NotFound and Unavailable."""
        ...

    def camera_settings(self, camera: str) -> CameraSettings:
        """Returns the exposure, gain and white balance that were requested of a camera. Raises NotFound."""
        ...

    def set_camera(self, camera: str, changes: Mapping[str, float | None]) -> CameraSettings:
        """Changes settings of a camera from now on; an open rig is opened anew. Raises NotFound, InputError and
        Conflict."""
        ...

    def lights(self) -> tuple[int, ...]:
        """Returns the light outputs that are on during a shot."""
        ...

    def set_lights(self, outputs: tuple[int, ...]) -> tuple[int, ...]:
        """Changes which light outputs are on during a shot, from now on. Raises InputError and Conflict."""
        ...

    def take_background(self) -> CleanPlates:
        """Takes new clean plates of the empty studio. Raises Unavailable, and Conflict where they show somebody."""
        ...

    def plates(self) -> list[PlatesVersion]:
        """Returns the clean plates in use and those kept, newest first."""
        ...

    def use_plates(self, version: str) -> None:
        """Puts clean plates that were kept to use again. Raises NotFound."""
        ...

    def use(self, calibration: Path) -> None:
        """Uses the calibration in a cameras.json file from now on. Raises Conflict if it is of another rig."""
        ...

    def close(self) -> None: ...


def check_names(rig: Rig, names: tuple[str, ...]) -> None:
    if set(rig.names) != set(names):
        differing = sorted(set(rig.names) ^ set(names))
        detail = compose("calibration-of-other-rig")
        raise Conflict("other-rig", detail, [compose("camera-in-one-alone", camera=name) for name in differing])


def rig_state(
    identity: str, kind: str, cameras: list[RigCamera], faults: list[Message], calibration: str | None
) -> RigState:
    ready = not faults and all(camera.state != "missing" for camera in cameras)
    return RigState(identity, kind, ready, tuple(cameras), tuple(faults), calibration)

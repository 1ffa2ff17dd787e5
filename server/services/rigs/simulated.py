"""Makes the simulated studio usable as the service's rig."""

import threading
from collections.abc import Mapping
from pathlib import Path

from rig.acquisition.plates import PlatesVersion
from rig.formats.cameras.cameras_json import read_rig, write_rig
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig
from server.errors import Conflict, NotFound, Unavailable
from server.services.records import CameraOut, CameraSettingsOut, CleanPlates, RigOut
from server.services.rigs.backend import check_names, jpeg, rig_state
from server.tasks.child import Child, WorkFailed
from server.tasks.simulate import SimulatedCertificate, look, simulated


class SimulatedRig:
    """Takes shots of the simulated studio, one at a time. A child process with an OpenGL context of its own renders
    them. The true shape of each subject is written beside its capture."""

    def __init__(self, calibration: Path) -> None:
        self._calibration = calibration
        self._child = Child(niceness=3)
        self._one_at_a_time = threading.Lock()

    def describe(self) -> RigOut:
        """Returns the state of the studio, whose cameras are always ready."""
        cameras = [CameraOut(name=name, driver="simulated", state="ready") for name in self._rig().names]
        return rig_state("simulated", "simulated", cameras, [], "own" if self._calibration.is_file() else "studio")

    def calibrated(self) -> Rig:
        """Returns the calibration that was put to use, or the studio's own layout."""
        return read_rig(self._calibration) if self._calibration.is_file() else self._rig()

    def capture(self, folder: Path, *, seed: int | None, board: bool = False) -> SimulatedCertificate:
        """Takes a shot of a person, also if ``board`` is set, since the studio has no board. Raises Unavailable if the
        child process fails."""
        with self._one_at_a_time:
            try:
                shot = self._child.remote(simulated)(folder=str(folder), seed=seed)
            except WorkFailed as error:
                raise Unavailable("shot-failed", error.message, [error.message]) from error
        if self._calibration.is_file():
            write_rig(self.calibrated(), folder / "files" / "cameras.json")
        return shot

    def look(self) -> Mapping[str, ImageRgb]:
        """Renders what each camera sees. The subject is the same every time."""
        with self._one_at_a_time:
            return self._child.remote(look)(cameras=list(self._rig().names))

    def preview(self, camera: str) -> bytes:
        """Renders what one camera sees, as a JPEG file. Raises NotFound for an unknown camera."""
        if camera not in self._rig():
            raise NotFound(compose("thing-rig-camera"), camera, compose("hint-rig"))
        with self._one_at_a_time:
            return jpeg(self._child.remote(look)(cameras=[camera])[camera])

    def camera_settings(self, camera: str) -> CameraSettingsOut:
        """Returns settings without values, since simulated cameras have none. Raises NotFound for an unknown camera."""
        if camera not in self._rig():
            raise NotFound(compose("thing-rig-camera"), camera, compose("hint-rig"))
        return CameraSettingsOut(exposure_ms=None, gain_db=None, white_balance_k=None, unmet=())

    def set_camera(self, camera: str, changes: Mapping[str, float | None]) -> CameraSettingsOut:
        """Raises Conflict, since simulated cameras cannot be set; NotFound for an unknown camera."""
        self.camera_settings(camera)
        raise _fixed_studio()

    def lights(self) -> tuple[int, ...]:
        """Returns no outputs: the studio's lights are fixed."""
        return ()

    def set_lights(self, outputs: tuple[int, ...]) -> tuple[int, ...]:
        """Raises Conflict, since the studio's lights are fixed."""
        raise _fixed_studio()

    def take_background(self) -> CleanPlates:
        """Takes no pictures, since the studio takes clean plates with every shot. Returns its cameras and a note that
        says so."""
        return CleanPlates(self._rig().names, 2, compose("hint-studio-plates"))

    def plates(self) -> list[PlatesVersion]:
        """Returns no versions: the studio keeps no clean plates."""
        return []

    def use_plates(self, version: str) -> None:
        """Raises NotFound, since the studio keeps no clean plates."""
        raise NotFound(compose("thing-plates-version"), version, compose("hint-studio-plates"))

    def use(self, calibration: Path) -> None:
        """Writes the calibration into every later capture in place of the studio's true cameras. Raises Conflict if it
        has other cameras."""
        check_names(read_rig(calibration), self._rig().names)
        self._calibration.parent.mkdir(exist_ok=True)
        write_rig(read_rig(calibration), self._calibration)

    def close(self) -> None:
        """Ends the child process that renders."""
        self._child.close()

    @staticmethod
    def _rig() -> Rig:
        from rig.studio.scene.layout import default_layout

        return default_layout()


def _fixed_studio() -> Conflict:
    return Conflict("simulated-rig", compose("simulated-rig-fixed"))

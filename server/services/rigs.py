"""Implements the rig behind ``POST /v1/captures``: the simulated studio, or real cameras that a rig.toml names.

The calibration in use lies in ``<data>/rig/cameras.json``. Every later capture gets a copy of the calibration in use.
Without a calibration in use, captures get the default: the studio's layout, or the file that rig.toml names.
"""

import json
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from rig.acquisition.commands import take_board_shot
from rig.acquisition.judgement import PlatesRefused
from rig.acquisition.plates import PlatesVersion, link_plates, plates_versions
from rig.acquisition.session import RigSession
from rig.acquisition.shot import ShotDocument, ShotFailed
from rig.capture import Capture
from rig.errors import EigenheadError, InputError
from rig.files import write_atomically
from rig.formats.cameras.cameras_json import read_rig, write_rig
from rig.formats.captures.capture_folder import write_capture
from rig.formats.pictures.images import encode_image, write_image
from rig.formats.rig_toml import RigConfig, adjusted, read_rig_config
from rig.image import ImageRgb
from rig.messages.message import Message, compose, message_of
from rig.rig import Rig
from server.errors import Conflict, NotFound, Unavailable
from server.services.records import CameraOut, CameraSettingsOut, CleanPlates, RigOut
from server.storage.records import RIG_ADJUSTMENT, JsonObject, RigAdjustment
from server.tasks.child import Child, WorkFailed
from server.tasks.simulate import look, simulated

SHOT_BYTES = 64 << 20  # that a shot may take on the disk
PREVIEW_WIDTH = 640  # pixels
PREVIEW_QUALITY = 80  # of JPEG, 0 to 100


class RealRig:
    """Takes shots with the cameras of a rig.toml, one at a time.

    The cameras are opened at the first use and stay open. If opening the cameras fails, the next use tries again.
    Settings that the operator changed are stored beside the calibration in adjusted.json and apply after a restart.
    """

    def __init__(self, path: Path, calibration: Path) -> None:
        self._from_file: RigConfig = read_rig_config(path)
        self._adjusted = calibration.with_name("adjusted.json")
        self._config = adjusted(self._from_file, self._adjustment().cameras, self._adjustment().lights)
        self._calibration = calibration
        self._session: RigSession | None = None
        self._lock = threading.RLock()

    def describe(self) -> RigOut:
        """Returns the state of the rig. Unused cameras are "closed", which is not a fault; a missing calibration is a
        fault."""
        with self._lock:
            states = {} if self._session is None else self._session.states()
            error = None if self._session is None else self._session.trigger_error()
        cameras, faults = [], [] if error is None else [compose("located", where="trigger", fault=error)]
        for camera in self._config.cameras:
            state = states.get(camera.name)
            known = "closed" if state is None else "open" if state.opened else "missing"
            cameras.append(CameraOut(name=camera.name, driver=camera.driver, state=known))
            if state is not None and state.error:
                faults.append(compose("located", where=camera.name, fault=state.error))
        rig = self.calibrated()
        if rig is None:
            faults.append(compose("rig-not-calibrated"))
        return rig_state(self._config.name, "real", cameras, faults, None if rig is None else "own")

    def capture(self, folder: Path, *, seed: int | None, board: bool = False) -> ShotDocument:
        """Takes a shot and writes the capture, with links to the clean plates, or copies of them if the disk has no
        links. No file is written if a camera failed.

        Raises InputError for a seed, and Unavailable if the rig has no calibration (unless ``board`` is set), cannot be
        opened, or a camera fails.
        """
        if seed is not None:
            raise InputError("request", [compose("seed-of-real-rig")])
        if board:
            return self._board_shot(folder)
        rig = self.calibrated()
        if rig is None:
            raise Unavailable("not-calibrated", compose("capture-needs-calibration"))
        with self._lock:
            session = self._opened()
            shot = session.shoot()
            if not shot.complete:
                faults = [fault.message() for fault in shot.faults if fault.is_error]
                raise Unavailable("shot-failed", compose("shot-no-capture", faults=faults), faults)
            images = {name: image for name, image in shot.images.items() if name in rig}
            write_capture(folder / "files", Capture(images), rig)
            link_plates(session.plates, folder / "files" / "background")
        return shot.document()

    def _board_shot(self, folder: Path) -> ShotDocument:
        with self._lock:
            try:
                shot = take_board_shot(self._opened())
            except ShotFailed as error:
                faults = [fault.message() for fault in error.faults]
                raise Unavailable("shot-failed", compose("no-board-picture", faults=faults), faults) from error
        for name, image in shot.images.items():
            write_image(folder / "files" / "images" / f"{name}.png", image)
        return shot.document()

    def look(self) -> Mapping[str, ImageRgb]:
        """Takes one picture with each camera, without trigger. Raises Unavailable if the rig cannot be opened."""
        with self._lock:
            return self._opened().look()

    def preview(self, camera: str) -> bytes:
        """Takes one picture with one camera and returns it as a JPEG file. Raises NotFound for an unknown camera, and
        Unavailable if the camera delivers no picture."""
        check_camera(camera, self._config.names)
        with self._lock:
            image = self._opened().look([camera]).get(camera)
        if image is None:
            raise Unavailable("camera-missing", compose("camera-without-picture", camera=camera), [camera])
        return encode_jpeg(image)

    def camera_settings(self, camera: str) -> CameraSettingsOut:
        """Returns the settings requested of a camera, by rig.toml or by the operator, and those that the driver did not
        accept. Raises NotFound for an unknown camera."""
        check_camera(camera, self._config.names)
        wanted = next(found for found in self._config.cameras if found.name == camera)
        with self._lock:
            state = None if self._session is None else self._session.states().get(camera)
        unmet = () if state is None else tuple(message_of(line) for line in state.unmet)
        return CameraSettingsOut(
            exposure_ms=wanted.exposure_ms, gain_db=wanted.gain_db, white_balance_k=wanted.white_balance_k, unmet=unmet
        )

    def set_camera(self, camera: str, changes: Mapping[str, float | None]) -> CameraSettingsOut:
        """Changes settings of a camera and stores them in adjusted.json. An open rig is closed and opened again,
        because drivers apply settings when they open. Raises NotFound and InputError."""
        self.camera_settings(camera)
        with self._lock:
            before = self._adjustment()
            of_camera = before.cameras.get(camera, {}) | dict(changes)
            self._adjust(replace(before, cameras=before.cameras | {camera: of_camera}))
            return self.camera_settings(camera)

    def lights(self) -> tuple[int, ...]:
        """Returns the numbers of the trigger box's light outputs that are on during a shot."""
        return self._config.lights.outputs

    def set_lights(self, outputs: tuple[int, ...]) -> tuple[int, ...]:
        """Chooses the light outputs that are on during a shot and stores the choice in adjusted.json. Raises InputError
        for wrong outputs."""
        with self._lock:
            self._adjust(replace(self._adjustment(), lights=outputs))
            return self.lights()

    def _adjustment(self) -> RigAdjustment:
        """Reads the settings that were changed over HTTP; a file that cannot be read counts as none."""
        with suppress(OSError, ValueError):
            return RIG_ADJUSTMENT.read(json.loads(self._adjusted.read_bytes()))
        return RigAdjustment({})

    def _adjust(self, wanted: RigAdjustment) -> None:
        """Stores the adjustment; an open rig is opened again, because drivers apply settings only when they open."""
        config = adjusted(self._from_file, wanted.cameras, wanted.lights)
        self._adjusted.parent.mkdir(exist_ok=True)
        write_atomically(self._adjusted, json.dumps(RIG_ADJUSTMENT.document(wanted), indent=1).encode())
        self._config = config
        if self._session is not None:
            self.close()
            with suppress(Unavailable):  # the rig's state says what is missing
                self._opened()

    def take_background(self) -> CleanPlates:
        """Takes clean plates with all cameras and uses them for later captures. Raises Unavailable if cameras fail, and
        Conflict if the plates show a person; ``use_plates`` can still select such plates."""
        with self._lock:
            try:
                plates = self._opened().take_plates()
            except PlatesRefused as error:
                faults = [fault.measured() for fault in error.faults]
                detail = compose("plates-occupied", version=error.version)
                raise Conflict("plates-occupied", detail, faults) from error
            except ShotFailed as error:
                faults = [fault.message() for fault in error.faults]
                raise Unavailable("plates-failed", error.message, faults) from error
        return CleanPlates(tuple(sorted(plates.files)), self._config.shot.plates, None)

    def plates(self) -> list[PlatesVersion]:
        """Returns the versions of clean plates on the disk, newest first."""
        return plates_versions(self._config.plates_folder)

    def use_plates(self, version: str) -> None:
        """Selects a version of the clean plates for later captures. Raises NotFound for an unknown version, and
        Unavailable if the rig cannot be opened."""
        with self._lock:
            if all(kept.id != version for kept in self.plates()):
                raise NotFound(compose("thing-plates-version"), version, compose("hint-plates"))
            self._opened().use_plates(version)

    def use(self, calibration: Path) -> None:
        """Copies a calibration to the data folder and uses it for every later shot. Raises Conflict if its cameras are
        not those of rig.toml."""
        rig = read_rig(calibration)
        check_names(rig, self._config.names)
        self._calibration.parent.mkdir(exist_ok=True)
        write_rig(rig, self._calibration)
        with self._lock:
            if self._session is not None:
                self._session.rig = rig

    def close(self) -> None:
        """Closes the cameras. The next use opens the cameras again."""
        with self._lock:
            if self._session is not None:
                self._session.close()
                self._session = None

    def _opened(self) -> RigSession:
        if self._session is None:
            session = RigSession(self._config)
            try:
                session.open()
                session.warm_up()
            except EigenheadError as error:
                session.close()
                raise Unavailable("rig-unavailable", error.message, [error.message]) from error
            session.rig = self.calibrated()
            self._session = session
        return self._session

    def calibrated(self) -> Rig | None:
        """Returns the calibrated cameras; None without a calibration."""
        if self._calibration.is_file():
            return read_rig(self._calibration)
        with suppress(InputError):
            if self._config.calibration_file is not None:
                return read_rig(self._config.calibration_file)
        return None


class SimulatedRig:
    """Takes shots of the simulated studio, one at a time. A child process with its own OpenGL context renders them. The
    true shape of each subject is written beside its capture."""

    def __init__(self, calibration: Path) -> None:
        self._calibration = calibration
        self._child = Child(niceness=3)
        self._one_at_a_time = threading.Lock()

    def describe(self) -> RigOut:
        """Returns the state of the studio, whose cameras are always ready."""
        cameras = [CameraOut(name=name, driver="simulated", state="ready") for name in self._rig().names]
        return rig_state("simulated", "simulated", cameras, [], "own" if self._calibration.is_file() else "studio")

    def calibrated(self) -> Rig:
        """Returns the calibration in use, or the studio's own layout."""
        return read_rig(self._calibration) if self._calibration.is_file() else self._rig()

    def capture(self, folder: Path, *, seed: int | None, board: bool = False) -> JsonObject:
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
        """Renders what each camera sees. The subject is the same in every call."""
        with self._one_at_a_time:
            return self._child.remote(look)(cameras=list(self._rig().names))

    def preview(self, camera: str) -> bytes:
        """Renders what one camera sees, as a JPEG file. Raises NotFound for an unknown camera."""
        check_camera(camera, self._rig().names)
        with self._one_at_a_time:
            return encode_jpeg(self._child.remote(look)(cameras=[camera])[camera])

    def camera_settings(self, camera: str) -> CameraSettingsOut:
        """Returns settings without values, since simulated cameras have none. Raises NotFound for an unknown camera."""
        check_camera(camera, self._rig().names)
        return CameraSettingsOut(exposure_ms=None, gain_db=None, white_balance_k=None, unmet=())

    def set_camera(self, camera: str, changes: Mapping[str, float | None]) -> CameraSettingsOut:
        """Raises Conflict, since simulated cameras cannot be set; NotFound for an unknown camera."""
        self.camera_settings(camera)
        raise Conflict("simulated-rig", compose("simulated-rig-fixed"))

    def lights(self) -> tuple[int, ...]:
        """Returns no outputs: the studio's lights are fixed."""
        return ()

    def set_lights(self, outputs: tuple[int, ...]) -> tuple[int, ...]:
        """Raises Conflict, since the studio's lights are fixed."""
        raise Conflict("simulated-rig", compose("simulated-rig-fixed"))

    def take_background(self) -> CleanPlates:
        """Takes no pictures, since the studio takes clean plates with every shot. Returns the studio's cameras and a
        note that states the reason."""
        return CleanPlates(self._rig().names, 2, compose("hint-studio-plates"))

    def plates(self) -> list[PlatesVersion]:
        """Returns no versions: the studio keeps no clean plates."""
        return []

    def use_plates(self, version: str) -> None:
        """Raises NotFound, since the studio keeps no clean plates."""
        raise NotFound(compose("thing-plates-version"), version, compose("hint-studio-plates"))

    def use(self, calibration: Path) -> None:
        """Writes the calibration into every later capture in place of the studio's true cameras. Raises Conflict if the
        calibration has other cameras."""
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


RigBackend = RealRig | SimulatedRig


def check_camera(camera: str, names: tuple[str, ...]) -> None:
    """Raises NotFound for a camera that the rig does not have."""
    if camera not in names:
        raise NotFound(compose("thing-rig-camera"), camera, compose("hint-rig"))


def check_names(rig: Rig, names: tuple[str, ...]) -> None:
    """Raises Conflict naming the differences if a calibration does not have exactly the cameras ``names``."""
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


def encode_jpeg(image: ImageRgb) -> bytes:
    """Encodes an RGB image as a JPEG file. An image wider than ``PREVIEW_WIDTH`` pixels is reduced to that width."""
    return encode_image(".jpg", reduced(image, PREVIEW_WIDTH), (cv2.IMWRITE_JPEG_QUALITY, PREVIEW_QUALITY))


def reduced(image: ImageRgb, width: int) -> ImageRgb:
    """Returns an image no wider than ``width`` pixels; its proportions stay. A smaller image is returned as it is."""
    if image.shape[1] <= width:
        return image
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)

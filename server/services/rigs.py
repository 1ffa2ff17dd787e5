"""The rig behind ``POST /v1/captures``: the simulated studio, or real cameras named by a rig.toml.

A calibration that was put to use lies in ``<data>/rig/cameras.json`` and goes into every capture from then on; until
then the rig's own one does (the studio's layout, or what rig.toml names).
"""

import json
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from rig.acquisition.commands import board_shot
from rig.acquisition.plate_checks import PlatesRefused
from rig.acquisition.plates import PlatesVersion, link_plates, plates_versions
from rig.acquisition.session import RigSession
from rig.acquisition.shot import ShotDocument, ShotFailed
from rig.atomic_write import write_atomically
from rig.capture import Capture
from rig.errors import EigenheadError, InputError
from rig.formats.cameras_json import read_rig, write_rig
from rig.formats.capture_folder import write_capture
from rig.formats.images import write_image
from rig.formats.rig_toml import RigConfig, adjusted, read_rig_config
from rig.image import ImageRgb
from rig.messages.message import Message, compose, message_of
from rig.rig import Rig
from server.errors import Conflict, NotFound, Unavailable
from server.services.records import CameraSettings, CleanPlates, RigCamera, RigState
from server.settings import ServiceSettings
from server.storage.records import RIG_ADJUSTMENT, RigAdjustment
from server.tasks.child import Child, WorkFailed
from server.tasks.simulate import SimulatedCertificate, look, simulated

PREVIEW_WIDTH = 640
PREVIEW_QUALITY = 80
SHOT_BYTES = 64 << 20


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


class SimulatedRig:
    """Takes shots of the simulated studio, rendered in a child process with a GL context of its own. The truth of a
    shot is kept beside it."""

    def __init__(self, calibration: Path) -> None:
        self._calibration = calibration
        self._child = Child(niceness=3)
        self._one_at_a_time = threading.Lock()

    def describe(self) -> RigState:
        rig = self._rig()
        cameras = [RigCamera(name, "simulated", "ready") for name in rig.names]
        calibrated = "own" if self._calibration.is_file() else "studio"
        return _state("simulated", "simulated", cameras, [], calibrated)

    def capture(self, folder: Path, *, seed: int | None, board: bool = False) -> SimulatedCertificate:
        """Takes a shot of a person even if ``board`` is set: the studio has no board to show."""
        with self._one_at_a_time:
            try:
                shot = self._child.remote(simulated)(folder=str(folder), seed=seed)
            except WorkFailed as error:
                raise Unavailable("shot-failed", error.message, [error.message]) from error
        if self._calibration.is_file():
            write_rig(read_rig(self._calibration), folder / "files" / "cameras.json")
        return shot

    def look(self) -> Mapping[str, ImageRgb]:
        with self._one_at_a_time:
            return self._child.remote(look)(cameras=list(self._rig().names))

    def preview(self, camera: str) -> bytes:
        if camera not in self._rig():
            raise NotFound(compose("thing-rig-camera"), camera, compose("hint-rig"))
        with self._one_at_a_time:
            return jpeg(self._child.remote(look)(cameras=[camera])[camera])

    def camera_settings(self, camera: str) -> CameraSettings:
        if camera not in self._rig():
            raise NotFound(compose("thing-rig-camera"), camera, compose("hint-rig"))
        return CameraSettings(None, None, None, ())

    def set_camera(self, camera: str, changes: Mapping[str, float | None]) -> CameraSettings:
        self.camera_settings(camera)
        raise fixed_studio()

    def lights(self) -> tuple[int, ...]:
        return ()

    def set_lights(self, outputs: tuple[int, ...]) -> tuple[int, ...]:
        raise fixed_studio()

    def take_background(self) -> CleanPlates:
        """Takes no pictures: the simulated studio takes clean plates with every shot. Returns its
        cameras and a note."""
        return CleanPlates(self._rig().names, 2, compose("hint-studio-plates"))

    def plates(self) -> list[PlatesVersion]:
        return []

    def use_plates(self, version: str) -> None:
        raise NotFound(compose("thing-plates-version"), version, compose("hint-studio-plates"))

    def use(self, calibration: Path) -> None:
        _check_names(read_rig(calibration), self._rig().names)
        self._calibration.parent.mkdir(exist_ok=True)
        write_rig(read_rig(calibration), self._calibration)

    def close(self) -> None:
        self._child.close()

    @staticmethod
    def _rig() -> Rig:
        from rig.studio.scene.layout import default_layout

        return default_layout()


class RealRig:
    """Takes shots with the cameras of a rig.toml. The rig is opened when first needed and stays open; where that fails,
    it is tried again."""

    def __init__(self, path: Path, calibration: Path) -> None:
        self._from_file: RigConfig = read_rig_config(path)
        self._adjusted = calibration.with_name("adjusted.json")
        self._config = adjusted(self._from_file, self._adjustment().cameras, self._adjustment().lights)
        self._calibration = calibration
        self._session: RigSession | None = None
        self._lock = threading.RLock()

    def describe(self) -> RigState:
        with self._lock:
            states = {} if self._session is None else self._session.states()
            error = None if self._session is None else self._session.trigger_error()
        cameras, faults = [], [] if error is None else [compose("located", where="trigger", fault=error)]
        for camera in self._config.cameras:
            state = states.get(camera.name)
            known = "closed" if state is None else "open" if state.opened else "missing"
            cameras.append(RigCamera(camera.name, camera.driver, known))
            if state is not None and state.error:
                faults.append(compose("located", where=camera.name, fault=state.error))
        rig = self._calibrated()
        if rig is None:
            faults.append(compose("rig-not-calibrated"))
        return _state(self._config.name, "real", cameras, faults, None if rig is None else "own")

    def capture(self, folder: Path, *, seed: int | None, board: bool = False) -> ShotDocument:
        if seed is not None:
            raise InputError("request", [compose("seed-of-real-rig")])
        if board:
            return self._board_shot(folder)
        rig = self._calibrated()
        if rig is None:
            detail = compose("capture-needs-calibration")
            raise Unavailable("not-calibrated", detail)
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
                shot = board_shot(self._opened())
            except ShotFailed as error:
                faults = [fault.message() for fault in error.faults]
                raise Unavailable("shot-failed", compose("no-board-picture", faults=faults), faults) from error
        for name, image in shot.images.items():
            write_image(folder / "files" / "images" / f"{name}.png", image)
        return shot.document()

    def look(self) -> Mapping[str, ImageRgb]:
        with self._lock:
            return self._opened().look()

    def preview(self, camera: str) -> bytes:
        if camera not in self._config.names:
            raise NotFound(compose("thing-rig-camera"), camera, compose("hint-rig"))
        with self._lock:
            image = self._opened().look([camera]).get(camera)
        if image is None:
            raise Unavailable("camera-missing", compose("camera-without-picture", camera=camera), [camera])
        return jpeg(image)

    def camera_settings(self, camera: str) -> CameraSettings:
        wanted = next((found for found in self._config.cameras if found.name == camera), None)
        if wanted is None:
            raise NotFound(compose("thing-rig-camera"), camera, compose("hint-rig"))
        with self._lock:
            state = None if self._session is None else self._session.states().get(camera)
        unmet = () if state is None else tuple(message_of(line) for line in state.unmet)
        return CameraSettings(wanted.exposure_ms, wanted.gain_db, wanted.white_balance_k, unmet)

    def set_camera(self, camera: str, changes: Mapping[str, float | None]) -> CameraSettings:
        self.camera_settings(camera)
        with self._lock:
            before = self._adjustment()
            of_camera = before.cameras.get(camera, {}) | dict(changes)
            self._adjust(replace(before, cameras=before.cameras | {camera: of_camera}))
            return self.camera_settings(camera)

    def lights(self) -> tuple[int, ...]:
        return self._config.lights.outputs

    def set_lights(self, outputs: tuple[int, ...]) -> tuple[int, ...]:
        with self._lock:
            self._adjust(replace(self._adjustment(), lights=outputs))
            return self.lights()

    def _adjustment(self) -> RigAdjustment:
        """What was changed over HTTP; a file that cannot be read is as none."""
        with suppress(OSError, ValueError):
            return RIG_ADJUSTMENT.read(json.loads(self._adjusted.read_bytes()))
        return RigAdjustment({})

    def _adjust(self, wanted: RigAdjustment) -> None:
        """Keeps the adjustment; a rig that is open is opened anew, which is how drivers take settings."""
        config = adjusted(self._from_file, wanted.cameras, wanted.lights)
        self._adjusted.parent.mkdir(exist_ok=True)
        write_atomically(self._adjusted, json.dumps(RIG_ADJUSTMENT.document(wanted), indent=1).encode())
        self._config = config
        if self._session is not None:
            self.close()
            with suppress(Unavailable):  # the rig's state says what is missing
                self._opened()

    def take_background(self) -> CleanPlates:
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
        return plates_versions(self._config.plates_folder)

    def use_plates(self, version: str) -> None:
        with self._lock:
            if all(kept.id != version for kept in self.plates()):
                raise NotFound(compose("thing-plates-version"), version, compose("hint-plates"))
            self._opened().use_plates(version)

    def use(self, calibration: Path) -> None:
        rig = read_rig(calibration)
        _check_names(rig, self._config.names)
        self._calibration.parent.mkdir(exist_ok=True)
        write_rig(rig, self._calibration)
        with self._lock:
            if self._session is not None:
                self._session.rig = rig

    def close(self) -> None:
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
            if self._calibration.is_file():
                session.rig = read_rig(self._calibration)
            self._session = session
        return self._session

    def _calibrated(self) -> Rig | None:
        if self._calibration.is_file():
            return read_rig(self._calibration)
        with suppress(InputError):
            if self._config.calibration_file is not None:
                return read_rig(self._config.calibration_file)
        return None


def fixed_studio() -> Conflict:
    detail = compose("simulated-rig-fixed")
    return Conflict("simulated-rig", detail)


def open_rig(settings: ServiceSettings) -> RigBackend:
    """Returns the rig of the settings: simulated, or described by a rig.toml. Raises InputError naming every fault of
    rig.toml."""
    calibration = settings.data / "rig" / "cameras.json"
    return SimulatedRig(calibration) if settings.rig is None else RealRig(settings.rig, calibration)


def jpeg(image: ImageRgb, width: int = PREVIEW_WIDTH) -> bytes:
    """Encodes RGB pixels as a JPEG file, reduced to a width of at most ``width`` pixels."""
    small = reduced(image, width)
    done, data = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, PREVIEW_QUALITY])
    assert done
    return data.tobytes()


def reduced(image: ImageRgb, width: int) -> ImageRgb:
    """Returns the image, reduced to a width of ``width`` pixels where it is wider."""
    if image.shape[1] <= width:
        return image
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _check_names(rig: Rig, names: tuple[str, ...]) -> None:
    if set(rig.names) != set(names):
        differing = sorted(set(rig.names) ^ set(names))
        detail = compose("calibration-of-other-rig")
        raise Conflict("other-rig", detail, [compose("camera-in-one-alone", camera=name) for name in differing])


def _state(
    identity: str, kind: str, cameras: list[RigCamera], faults: list[Message], calibration: str | None
) -> RigState:
    ready = not faults and all(camera.state != "missing" for camera in cameras)
    return RigState(identity, kind, ready, tuple(cameras), tuple(faults), calibration)

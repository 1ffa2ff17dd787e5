"""Cameras through OpenCV: UVC and other V4L2 cameras by their stable path, RTSP by address; motion JPEG over HTTP is
read by rig.drivers.mjpeg and decoded by OpenCV.

V4L2 stamps its buffers with CLOCK_MONOTONIC, which is time.monotonic; that stamp is used where it is plausible.
"""

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rig.drivers.base import Arrival, CameraLost, CameraNotFound, Driver, DriverError, GrabTimeout
from rig.drivers.mjpeg import MjpegStream, StreamBroken, StreamTimeout
from rig.formats.rig_toml import CameraConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose

_READ_LIMIT_S = 1.0  # of VideoCapture.grab, which takes no timeout of its own: it may overstay by that much
_STALE_S = 1.0  # a kernel stamp further from now than this is of another clock
_ADDRESSES = ("http://", "https://")
_NEAR = 0.05


def make(camera: CameraConfig, folder: Path) -> Driver:
    """Returns the driver for an address or a device path: MjpegDriver for http, else VideoCaptureDriver."""
    return MjpegDriver(camera) if camera.identity.startswith(_ADDRESSES) else VideoCaptureDriver(camera)


class MjpegDriver:
    """Reads a motion-JPEG stream over HTTP."""

    live = True

    def __init__(self, camera: CameraConfig) -> None:
        self._camera = camera
        self._stream: MjpegStream | None = None
        self._jpeg = b""
        self._sequence = 0

    def open(self, timeout_s: float) -> None:
        """Connects to the camera's address. Raises CameraNotFound."""
        self.close()
        try:
            self._stream = MjpegStream(self._camera.identity, timeout_s)
        except (OSError, StreamBroken, StreamTimeout, ValueError) as error:
            raise CameraNotFound(self._camera, _reason(error, compose("no-answer"))) from error

    def configure(self) -> tuple[Message, ...]:
        """Returns one message for each setting in rig.toml of exposure, gain or white balance: none of them can be set
        over HTTP."""
        requested = [
            key for key in ("exposure_ms", "gain_db", "white_balance_k") if getattr(self._camera, key) is not None
        ]
        return tuple(compose("not-set-over-http", setting=key) for key in requested)

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next JPEG file of the stream, without decoding it. Raises GrabTimeout, CameraLost."""
        if self._stream is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        try:
            time_s, self._jpeg = self._stream.next_part(timeout_s)
        except StreamTimeout as error:
            raise GrabTimeout(self._camera, timeout_s) from error
        except (OSError, StreamBroken) as error:
            raise CameraLost(self._camera, _reason(error, compose("connection-lost"))) from error
        self._sequence += 1
        return Arrival(time_s, self._sequence)

    def retrieve(self) -> ImageRgb:
        """Decodes the JPEG file of the last ``grab``. Raises DriverError if it is damaged."""
        return decode_jpeg(self._camera, self._jpeg)

    def trigger(self) -> None:
        """Does nothing: such a stream has no software trigger."""
        return

    def close(self) -> None:
        """Ends the connection."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None


class VideoCaptureDriver:
    """Reads the sources that cv2.VideoCapture opens: /dev/v4l/by-id/..., /dev/v4l/by-path/..., rtsp://..."""

    live = True

    def __init__(self, camera: CameraConfig) -> None:
        self._camera = camera
        self._capture: cv2.VideoCapture | None = None
        self._sequence = 0
        self._is_device = camera.identity.startswith("/")

    def open(self, timeout_s: float) -> None:
        """Opens the device or address. Raises CameraNotFound."""
        self.close()
        target, backend = self._camera.identity, cv2.CAP_FFMPEG
        if self._is_device:
            if not Path(target).exists():
                raise CameraNotFound(self._camera, compose("no-such-device"))
            target, backend = str(Path(target).resolve()), cv2.CAP_V4L2
        options = [] if self._is_device else [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(1, round(timeout_s * 1000))]
        read = [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(_READ_LIMIT_S * 1000)]
        capture = cv2.VideoCapture(target, backend, [*options, *read])
        if not capture.isOpened():
            capture.release()
            raise CameraNotFound(self._camera, compose("no-video-source"))
        self._capture = capture

    def configure(self) -> tuple[Message, ...]:
        """Applies the settings of rig.toml. Returns one message for each that the device did not take; 5 % off counts
        as taken."""
        capture = self._opened()
        unmet = [
            compose("setting-not-taken", setting=key, value=str(wanted), actual=capture.get(prop))
            for key, wanted, prop, value in self._settings()
            if not capture.set(prop, value) or not _is_taken(prop, value, capture.get(prop))
        ]
        return tuple(unmet)

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next frame, at most about a second whatever ``timeout_s`` is. Raises GrabTimeout,
        CameraLost."""
        capture = self._opened()
        started_s = time.monotonic()
        if not capture.grab():
            # OpenCV tells a timeout and a lost camera apart by nothing but the time that they took.
            if time.monotonic() - started_s >= 0.9 * _READ_LIMIT_S:
                raise GrabTimeout(self._camera, timeout_s)
            raise CameraLost(self._camera, compose("no-more-frames"))
        self._sequence += 1
        return Arrival(self._stamp_s(capture), self._sequence)

    def retrieve(self) -> ImageRgb:
        """Decodes the frame of the last ``grab``. Raises DriverError if that fails."""
        done, image = self._opened().retrieve()
        if not done or image is None:
            raise DriverError(self._camera.name, compose("frame-not-decoded"))
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.ndim == 3 else cv2.COLOR_GRAY2RGB)

    def trigger(self) -> None:
        """Does nothing: these sources have no software trigger."""
        return

    def close(self) -> None:
        """Releases the device or connection."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _opened(self) -> cv2.VideoCapture:
        if self._capture is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        return self._capture

    def _stamp_s(self, capture: cv2.VideoCapture) -> float:
        now_s = time.monotonic()
        kernel_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000 if self._is_device else 0.0
        return kernel_s if 0 <= now_s - kernel_s < _STALE_S else now_s

    def _settings(self) -> list[tuple[str, Any, int, float]]:
        camera = self._camera
        settings: list[tuple[str, Any, int, float]] = []
        if camera.pixel_format is not None:
            code = cv2.VideoWriter.fourcc(*camera.pixel_format[:4].ljust(4))
            settings.append(("pixel_format", camera.pixel_format, cv2.CAP_PROP_FOURCC, code))
        for key, prop in (
            ("width", cv2.CAP_PROP_FRAME_WIDTH),
            ("height", cv2.CAP_PROP_FRAME_HEIGHT),
            ("fps", cv2.CAP_PROP_FPS),
        ):
            if getattr(camera, key) is not None:
                settings.append((key, getattr(camera, key), prop, getattr(camera, key)))
        if camera.exposure_ms is not None:
            settings.append(("manual exposure", 1, cv2.CAP_PROP_AUTO_EXPOSURE, 1))  # V4L2_EXPOSURE_MANUAL
            # V4L2_CID_EXPOSURE_ABSOLUTE counts 100 us
            settings.append(("exposure_ms", camera.exposure_ms, cv2.CAP_PROP_EXPOSURE, camera.exposure_ms * 10))
        if camera.gain_db is not None:
            settings.append(("gain_db", camera.gain_db, cv2.CAP_PROP_GAIN, camera.gain_db))
        if camera.white_balance_k is not None:
            settings.append(("manual white balance", 0, cv2.CAP_PROP_AUTO_WB, 0))
            settings.append(
                ("white_balance_k", camera.white_balance_k, cv2.CAP_PROP_WB_TEMPERATURE, camera.white_balance_k)
            )
        return settings


def decode_jpeg(camera: CameraConfig, data: bytes) -> ImageRgb:
    """Decodes a JPEG file to RGB pixels. Raises DriverError where the file is damaged."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
    if image is None:
        raise DriverError(camera.name, compose("frame-no-picture", bytes=len(data)))
    return image


def _is_taken(prop: int, wanted: float, actual: float) -> bool:
    """Tells whether a value was set: within a twentieth, as cameras have steps; exactly for a pixel format."""
    return abs(actual - wanted) <= (0.0 if prop == cv2.CAP_PROP_FOURCC else _NEAR * abs(wanted))


def _reason(error: Exception, otherwise: Message) -> Message | str:
    if isinstance(error, StreamBroken):
        return error.message
    return str(error).splitlines()[0] if str(error) else otherwise

"""Controls cameras through OpenCV (UVC and other V4L2 cameras, RTSP), and reads motion JPEG over HTTP.

V4L2 puts a time stamp of CLOCK_MONOTONIC on each buffer. The driver uses plausible V4L2 time stamps as times of
arrival, because time.monotonic is the same clock.

A motion JPEG stream is a multipart/x-mixed-replace body (RFC 2046, section 5.1). This module decodes only requested
frames; OpenCV's reader would decode every frame before reporting it. A frame's time of arrival is the time at which the
kernel received the frame's header.
"""

import base64
import contextlib
import re
import socket
import ssl
import struct
import time
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from rig.drivers.base import Arrival, CameraLost, CameraNotFound, Driver, DriverError, GrabTimeout
from rig.formats.rig_toml import CameraConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose

_READ_LIMIT_S = 1.0  # of VideoCapture.grab, which takes no timeout of its own: it may overstay by that much
_STALE_S = 1.0  # a kernel stamp further from now than this is of another clock
_ADDRESSES = ("http://", "https://")
_NEAR = 0.05
HEAD_MOST = 64 * 1024
PART_MOST = 64 * 1024 * 1024
_CHUNK = 256 * 1024
_HEAD_CHUNK = 1024  # no more than that beyond a header, for the kernel stamps what is read by its last packet
_SO_TIMESTAMPNS = 35  # Linux, asm-generic/socket.h; the socket module does not name it
_TIMESPEC = struct.Struct("@qq")
_STREAM_STALE_S = 5.0  # a kernel stamp of a packet further from now than this is of a clock that was set meanwhile


class StreamTimeout(Exception):
    """Reports that a stream delivered no data in time. Reading may continue."""


class StreamBroken(Exception):
    """Reports that the stream ended, or is not motion JPEG."""

    def __init__(self, message: Message) -> None:
        self.message = message
        super().__init__(message)


class MjpegStream:
    """Reads one open stream of motion JPEG. Raises StreamTimeout, StreamBroken and OSError."""

    def __init__(self, url: str, timeout_s: float) -> None:
        deadline_s = time.monotonic() + timeout_s
        self._buffer = bytearray()
        self._part: tuple[float, int | None] | None = None  # arrival and length of the part being read
        self._received_s = 0.0  # when the kernel had what came last
        self._socket = connect(url, timeout_s)
        try:
            self.head = self._take_until(b"\r\n\r\n", deadline_s, HEAD_MOST)
            self._boundary = _boundary(self.head)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Ends the connection; the method may be called repeatedly."""
        self._socket.close()

    def next_part(self, timeout_s: float) -> tuple[float, bytes]:
        """Returns the time of arrival (time.monotonic, s) and the body of the stream's next part. If a timeout
        interrupts a part, the next call completes it."""
        deadline_s = time.monotonic() + timeout_s
        if self._part is None:
            self._take_until(self._boundary, deadline_s, HEAD_MOST)
            head = self._take_until(b"\r\n\r\n", deadline_s, HEAD_MOST, keep_on_timeout=self._boundary)
            length = re.search(rb"(?im)^content-length:\s*(\d+)", head)
            age = re.search(rb"(?im)^x-age-ms:\s*(\d{1,5}\.?\d*)", head)  # that a node says of its picture
            arrival_s = self._received_s - (float(age.group(1)) / 1000.0 if age else 0.0)
            self._part = (arrival_s, int(length.group(1)) if length else None)
        arrival_s, length = self._part
        if length is None:
            body = self._take_until(b"\r\n" + self._boundary, deadline_s, PART_MOST)
            self._buffer[:0] = self._boundary
        elif length > PART_MOST:
            raise StreamBroken(compose("stream-frame", bytes=str(length)))
        else:
            while len(self._buffer) < length:
                self._receive(deadline_s, min(_CHUNK, length - len(self._buffer)))
            body = bytes(self._buffer[:length])
            del self._buffer[:length]
        self._part = None
        return arrival_s, body

    def _take_until(self, mark: bytes, deadline_s: float, most: int, keep_on_timeout: bytes = b"") -> bytes:
        searched = 0
        while (at := self._buffer.find(mark, max(0, searched - len(mark)))) < 0:
            searched = len(self._buffer)
            if searched > most:
                raise StreamBroken(compose("stream-no-jpeg"))
            try:
                self._receive(deadline_s, _CHUNK if most == PART_MOST else _HEAD_CHUNK)
            except StreamTimeout:
                self._buffer[:0] = keep_on_timeout  # so that the next call finds the part's beginning again
                raise
        taken = bytes(self._buffer[:at])
        del self._buffer[: at + len(mark)]
        return taken

    def _receive(self, deadline_s: float, size: int) -> None:
        left_s = deadline_s - time.monotonic()
        if left_s <= 0:
            raise StreamTimeout
        self._socket.settimeout(left_s)
        try:
            data = self._read(size)
        except TimeoutError as error:
            raise StreamTimeout from error
        if not data:
            raise StreamBroken(compose("stream-ended"))
        self._buffer += data

    def _read(self, size: int) -> bytes:
        if isinstance(self._socket, ssl.SSLSocket):  # knows no recvmsg
            data = self._socket.recv(size)
            self._received_s = time.monotonic()
            return data
        data, notes, _, _ = self._socket.recvmsg(size, socket.CMSG_SPACE(_TIMESPEC.size))
        self._received_s = _stamp_s(notes)
        return data


def _stamp_s(notes: list[tuple[int, int, bytes]]) -> float:
    """Returns the time of arrival (time.monotonic, s) that the kernel reports, or else the current time."""
    now_s = time.monotonic()
    for level, kind, data in notes:
        if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS) and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            age_s = time.time() - (seconds + nanoseconds * 1e-9)
            if 0 <= age_s < _STREAM_STALE_S:
                return now_s - age_s
    return now_s


def connect(url: str, timeout_s: float, method: str = "GET") -> socket.socket:
    """Sends an HTTP request without a body, and returns the connection. Raises OSError."""
    parts = urlsplit(url)
    port = parts.port or (443 if parts.scheme == "https" else 80)
    host = parts.hostname or ""
    connection = socket.create_connection((host, port), timeout_s)
    try:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        if parts.scheme == "https":
            connection = ssl.create_default_context().wrap_socket(connection, server_hostname=host)
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        # HTTP/1.0: the answer then comes without chunked coding
        request = f"{method} {path} HTTP/1.0\r\nHost: {host}:{port}\r\nAccept: multipart/x-mixed-replace\r\n"
        if parts.username:
            secret = f"{unquote(parts.username)}:{unquote(parts.password or '')}".encode()
            request += f"Authorization: Basic {base64.b64encode(secret).decode('ascii')}\r\n"
        connection.sendall((request + "\r\n").encode("ascii"))
    except BaseException:
        connection.close()
        raise
    return connection


def _boundary(head: bytes) -> bytes:
    status = re.match(rb"HTTP/\d\.\d (\d{3})", head)
    if status is None:
        raise StreamBroken(compose("stream-no-http"))
    if status.group(1) != b"200":
        raise StreamBroken(compose("stream-http-status", status=status.group(1).decode()))
    kind = re.search(rb'(?im)^content-type:\s*multipart/x-mixed-replace\s*;\s*boundary="?([^"\r\n;]+)', head)
    if kind is None:
        raise StreamBroken(compose("stream-other-kind"))
    name = kind.group(1).strip()
    # Some cameras put the two dashes into the name already.
    return name if name.startswith(b"--") else b"--" + name


def make(camera: CameraConfig, folder: Path) -> Driver:
    """Creates an MjpegDriver for an HTTP address, and a VideoCaptureDriver for any other address or device path."""
    return MjpegDriver(camera) if camera.identity.startswith(_ADDRESSES) else VideoCaptureDriver(camera)


class MjpegDriver(Driver):
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
            self._stream = MjpegStream(self.address(), timeout_s)
        except (OSError, StreamBroken, StreamTimeout, ValueError) as error:
            raise CameraNotFound(self._camera, _reason(error, compose("no-answer"))) from error

    def address(self) -> str:
        """Returns the stream's address."""
        return self._camera.identity

    def header(self, name: str) -> str:
        """Returns a header of the open stream's response, or an empty text."""
        found = re.search(rf"(?im)^{name}:(.*)$", self._stream.head.decode("latin-1") if self._stream else "")
        return found.group(1).strip() if found else ""

    def configure(self) -> tuple[Message, ...]:
        """Returns one message for each setting of exposure, gain or white balance in rig.toml, because HTTP cannot set
        them."""
        return tuple(compose("not-set-over-http", setting=key) for key in self._camera.exposure_settings())

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
        """Decodes the JPEG file of the last ``grab``. Raises DriverError if the file is damaged."""
        return decode_jpeg(self._camera, self._jpeg)

    def close(self) -> None:
        """Ends the connection."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None


class VideoCaptureDriver(Driver):
    """Reads sources that cv2.VideoCapture can open: paths in /dev/v4l/by-id and /dev/v4l/by-path, and rtsp
    addresses."""

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
        """Applies the settings of rig.toml. Returns one message for each setting that the device changed by over 5
        %."""
        capture = self._opened()
        unmet = [
            compose("setting-not-taken", setting=key, value=str(wanted), actual=capture.get(prop))
            for key, wanted, prop, value in self._settings()
            if not capture.set(prop, value) or not _is_taken(prop, value, capture.get(prop))
        ]
        return tuple(unmet)

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next frame for about a second, regardless of ``timeout_s``. Raises GrabTimeout and
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
        """Decodes the frame of the last ``grab``. Raises DriverError if the frame cannot be decoded."""
        done, image = self._opened().retrieve()
        if not done or image is None:
            raise DriverError(self._camera.name, compose("frame-not-decoded"))
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.ndim == 3 else cv2.COLOR_GRAY2RGB)

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
    """Returns whether a camera took a value: a pixel format exactly, others within 5 %, because cameras have steps."""
    return abs(actual - wanted) <= (0.0 if prop == cv2.CAP_PROP_FOURCC else _NEAR * abs(wanted))


def _reason(error: Exception, otherwise: Message) -> Message | str:
    if isinstance(error, StreamBroken):
        return error.message
    return str(error).splitlines()[0] if str(error) else otherwise

"""Reads motion JPEG over HTTP: multipart/x-mixed-replace bodies (RFC 2046, section 5.1).

OpenCV's own reader decodes every frame before it reports it. Here a frame's arrival is when the kernel received its
header, whenever this program reads it, and a frame is decoded only if it is wanted.
"""

import base64
import contextlib
import re
import socket
import ssl
import struct
import time
from urllib.parse import unquote, urlsplit

from rig.messages.message import Message, compose

HEAD_MOST = 64 * 1024
PART_MOST = 64 * 1024 * 1024
_CHUNK = 256 * 1024
_HEAD_CHUNK = 1024  # no more than that beyond a header, for the kernel stamps what is read by its last packet
_SO_TIMESTAMPNS = 35  # Linux, asm-generic/socket.h; the socket module does not name it
_TIMESPEC = struct.Struct("@qq")
_STALE_S = 5.0  # a kernel stamp further from now than this is of a clock that was set meanwhile


class StreamTimeout(Exception):
    """Reports that nothing arrived in time. Reading may continue."""


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
        self._socket = _connect(url, timeout_s)
        try:
            head = self._take_until(b"\r\n\r\n", deadline_s, HEAD_MOST)
            self._boundary = _boundary(head)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Ends the connection. Safe to call twice."""
        self._socket.close()

    def next_part(self, timeout_s: float) -> tuple[float, bytes]:
        """Returns when the next part of the stream arrived (time.monotonic, s), and its body. A part that a timeout
        interrupted is completed by the next call."""
        deadline_s = time.monotonic() + timeout_s
        if self._part is None:
            self._take_until(self._boundary, deadline_s, HEAD_MOST)
            head = self._take_until(b"\r\n\r\n", deadline_s, HEAD_MOST, keep_on_timeout=self._boundary)
            length = re.search(rb"(?im)^content-length:\s*(\d+)", head)
            self._part = (self._received_s, int(length.group(1)) if length else None)
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
    """Returns the kernel's time of arrival on the clock of time.monotonic, or the present time if it gives none."""
    now_s = time.monotonic()
    for level, kind, data in notes:
        if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS) and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            age_s = time.time() - (seconds + nanoseconds * 1e-9)
            if 0 <= age_s < _STALE_S:
                return now_s - age_s
    return now_s


def _connect(url: str, timeout_s: float) -> socket.socket:
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
        request = f"GET {path} HTTP/1.0\r\nHost: {host}:{port}\r\nAccept: multipart/x-mixed-replace\r\n"
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

"""Attacks on a running service, each bounded and on loopback, and a witness who measures what others feel of them."""

import json
import resource
import socket
import statistics
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import httpx
import numpy as np

from server.services.keys import Keys
from server.settings import ServiceSettings
from server.storage.database import open_database
from tests.support.services import RunningService, packed, small_capture

ATTACKER, WITNESS = "127.0.0.3", "127.0.0.2"  # addresses of loopback: the bounds are by address
EVERY_S = 0.05


def limit_files(service: RunningService, count: int) -> None:
    """Sets ``ulimit -n`` of a running service."""
    assert service.process is not None
    resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE, (count, count))


def connect(service: RunningService, address: str = ATTACKER, buffer: int = 0) -> socket.socket:
    """A connection from an address, perhaps with a small buffer of what was not read."""
    sock = socket.socket()
    sock.settimeout(30)
    if buffer:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    sock.bind((address, 0))
    sock.connect(("127.0.0.1", service.port))
    return sock


REQUEST = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n"
CHUNKED = b"POST /v1/nowhere HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n1\r\na\r\n0\r\n"


def flood_header(service: RunningService, megabytes: int, begin: bytes = REQUEST) -> tuple[int, bytes]:
    """One header field in pieces of 64 KiB after ``begin``. Returns how many bytes were sent, and the answer."""
    sent, piece = 0, b"a" * (1 << 16)
    with connect(service) as sock:
        with suppress(ConnectionError):
            sock.sendall(begin + b"X-Long: ")
            while sent < megabytes * 1_000_000:
                sent += sock.send(piece)
        return sent, _answer(sock)


ASKING = """
import json, sys
from concurrent.futures import ThreadPoolExecutor
import cv2
import httpx
import numpy as np
url, key, count = sys.argv[1:]
with httpx.Client(headers={"Authorization": f"Bearer {key}"}, timeout=120) as http, ThreadPoolExecutor(100) as pool:
    print(json.dumps(list(pool.map(lambda _: http.get(url).status_code, range(int(count))))))
"""


@contextmanager
def silent_connections(
    service: RunningService, count: int, begin: bytes = b"", addresses: tuple[str, ...] = (ATTACKER,), buffer: int = 0
) -> Iterator[list[socket.socket]]:
    """Connections that send ``begin`` and then nothing, and read nothing."""
    with ExitStack() as stack:
        opened = []
        for number in range(count):
            sock = stack.enter_context(connect(service, addresses[number % len(addresses)], buffer))
            with suppress(ConnectionError):
                sock.sendall(begin)
            opened.append(sock)
        yield opened


def client(service: RunningService, key: str | None, timeout_s: float = 60.0) -> httpx.Client:
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    return httpx.Client(base_url=service.url, headers=headers, timeout=timeout_s)


def half_body(path: str, key: str | None = None) -> bytes:
    """The header of a JSON request and the first bytes of its body."""
    access = "" if key is None else f"Authorization: Bearer {key}\r\n"
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\n{access}Content-Type: application/json\r\n"
    return (head + 'Content-Length: 400\r\n\r\n{"capture_id": ').encode()


def get_begun(path: str, key: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {key}\r\n\r\n".encode()


def ask_often(service: RunningService, key: str, path: str, count: int = 2000) -> set[int]:
    """Sends small requests, 100 at once, from a process of its own: the witness has this one. Returns the statuses."""
    command = [sys.executable, "-c", ASKING, service.url + path, key, str(count)]
    return set(json.loads(subprocess.run(command, capture_output=True, check=True, timeout=300).stdout))


def seconds_to_end(sock: socket.socket, timeout_s: float) -> float:
    """How long the service leaves a connection open."""
    began = time.monotonic()
    sock.settimeout(timeout_s)
    _answer(sock)
    return time.monotonic() - began


def _answer(sock: socket.socket) -> bytes:
    answer = b""
    with suppress(ConnectionError):
        while piece := sock.recv(1 << 16):
            answer += piece
    return answer


@dataclass
class Witness:
    """Asks for /healthz and, with another key, for a list, again and again; holds seconds, failures and memory."""

    service: RunningService
    key: str | None = None
    healthz_s: list[float] = field(default_factory=list)
    others_s: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)

    @contextmanager
    def watching(self) -> Iterator["Witness"]:
        ended = threading.Event()
        thread = threading.Thread(target=self._watch, args=(ended,))
        thread.start()
        try:
            yield self
        finally:
            ended.set()
            thread.join()

    def _watch(self, ended: threading.Event) -> None:
        headers = {} if self.key is None else {"Authorization": f"Bearer {self.key}"}
        transport = httpx.HTTPTransport(local_address=WITNESS)
        with httpx.Client(base_url=self.service.url, headers=headers, transport=transport, timeout=60) as client:
            while not ended.wait(EVERY_S):
                for path, seconds in (("/healthz", self.healthz_s), ("/v1/captures", self.others_s)):
                    began = time.monotonic()
                    try:
                        client.get(path).raise_for_status()
                    except httpx.HTTPError as error:
                        self.failures.append(f"{path}: {error!r}")
                    seconds.append(time.monotonic() - began)
                self.memory_mb.append(memory_mb(self.service))

    @property
    def others_median_s(self) -> float:
        return statistics.median(self.others_s)

    def check(self, calm: "Witness") -> None:
        """Nothing failed or grew, and what took ``calm``, a witness of the same machine in peace, 3 ms in the median
        takes 8 ms beside a hundred requests of one key in turn, 82 without turns."""
        assert self.failures == []
        assert self.others_median_s < 8.0 * calm.others_median_s + 0.02
        assert max(self.healthz_s + self.others_s) < 1.0 + 10.0 * max(calm.healthz_s + calm.others_s)
        assert max(self.memory_mb) < max(calm.memory_mb) + 300.0


def memory_mb(service: RunningService) -> float:
    """Resident memory of the service's process and all below it (MB)."""
    assert service.process is not None
    return sum(_resident_mb(pid) for pid in process_tree(service.process.pid))


def process_tree(pid: int) -> list[int]:
    """A process and all below it."""
    below: list[int] = []
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            below += [int(child) for child in (task / "children").read_text().split()]
    return [pid, *(each for child in below for each in process_tree(child))]


def _resident_mb(pid: int) -> float:
    with suppress(OSError, StopIteration):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS:")).split()[1]) / 1000
    return 0.0


def jpeg_with_metadata(jpeg: bytes, megabytes: int, segment: int = 65_533) -> bytes:
    """A JPEG with so much EXIF before its pixels, in segments of ``segment`` bytes."""
    payload = b"Exif\0\0" + bytes(segment - 8)
    part = b"\xff\xe1" + segment.to_bytes(2, "big") + payload
    return jpeg[:2] + part * (megabytes * 1_000_000 // len(part)) + jpeg[2:]


def png_of_chunks(png: bytes, count: int) -> bytes:
    """A PNG with ``count`` empty chunks before its pixels: each takes its reader some microseconds."""
    at = 8 + 25  # after signature and header
    chunk = bytes(4) + b"teSt" + zlib.crc32(b"teSt").to_bytes(4, "big")
    return png[:at] + chunk * count + png[at:]


def spoiled_capture(folder: Path, change: Callable[[Path], None]) -> bytes:
    """An archive of a small capture after ``change``, which gets the capture's folder."""
    change(small_capture(folder))
    return packed(folder)


def slow_capture(folder: Path) -> bytes:
    """A capture whose check takes one process half a minute and more: a PNG of 4,000,000 chunks."""
    picture = small_capture(folder) / "images" / "cam00.png"
    picture.write_bytes(png_of_chunks(picture.read_bytes(), 4_000_000))
    return packed(folder)


def heavy_capture(folder: Path, segment: int = 65_533) -> bytes:
    """A capture with 60 MB of EXIF in a picture."""
    picture = small_capture(folder) / "images" / "cam00.png"
    jpeg = cv2.imencode(".jpg", np.zeros((24, 24, 3), np.uint8))[1].tobytes()
    picture.with_suffix(".jpg").write_bytes(jpeg_with_metadata(jpeg, 60, segment))
    picture.unlink()
    return packed(folder)


def add_keys(service: RunningService, *scopes: str) -> list[str]:
    """New keys of a running service, each with the named scopes (with commas between)."""
    engine = open_database(ServiceSettings(data=service.data))
    try:
        return [Keys(engine).add(f"key {number}", tuple(each.split(","))) for number, each in enumerate(scopes)]
    finally:
        engine.dispose()

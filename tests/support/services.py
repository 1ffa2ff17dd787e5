"""Real services for the tests: processes of their own, on free ports, with data folders of their own."""

import fcntl
import os
import signal
import socket
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx
import numpy as np

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.formats.captures.archive import pack_folder
from rig.formats.captures.capture_folder import write_capture
from rig.geometry import RigidTransform
from rig.rig import Rig
from tests.support import fork_server

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[2]
running: "list[RunningService]" = []


@dataclass
class RunningService:
    """A service process, perhaps with its worker, that can be killed and started again on the same data and port."""

    data: Path
    environment: dict[str, str]
    port: int
    worker: bool = True
    forked: bool = True
    process: "subprocess.Popen[bytes] | None" = None
    log: Path = field(init=False)

    def __post_init__(self) -> None:
        self.log = self.data.parent / f"{self.data.name}.log"

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self, terminal: int | None = None) -> None:
        """``terminal``: an open pseudo-terminal that becomes the service's own, so that Ctrl-C there reaches it."""
        command = [sys.executable, "-m", "server.cli", "serve", "--data", str(self.data), "--port", str(self.port)]
        with self.log.open("ab") as log:
            self.process = (fork_server.Popen if self.forked else fork_server.ExecPopen)(
                command + ([] if self.worker else ["--no-worker"]),
                env=os.environ | self.environment,
                cwd=ROOT,
                stdin=terminal,
                stderr=log,
                start_new_session=True,
                preexec_fn=None if terminal is None else lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
            )
        self.await_answer()

    def await_answer(self, timeout_s: float = 180.0) -> None:
        assert self.process is not None
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                break
            try:
                httpx.get(self.url + "/healthz", timeout=1.0)
                return
            except httpx.TransportError:
                time.sleep(0.05)
        raise AssertionError(f"the service did not start:\n{self.log.read_text()[-3000:]}")

    def log_end(self) -> str:
        return self.log.read_text()[-4000:] if self.log.is_file() else ""

    def kill(self) -> None:
        """SIGKILL of the service process alone."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def stop(self) -> None:
        if self.process is None or self.process.poll() is not None:
            return
        self.process.terminate()
        try:
            self.process.wait(15)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()


@contextmanager
def running_service(
    data: Path,
    *,
    worker: bool = True,
    terminal: int | None = None,
    forked: bool = True,
    variables: Mapping[str, str] | None = None,
    **settings: str,
) -> Iterator[RunningService]:
    """Without ``forked`` each process begins with exec, as an operator's does. ``settings`` become EIGENHEAD_<NAME>
    variables beside other ``variables``; the work is the tiny one unless given, and there are no pages. A test that
    fails shows the end of the logs of ``running``."""
    chosen = {"work": "tests.support.tiny:work", "heartbeat_s": "0.5", "poll_s": "0.1", "console": "false"} | settings
    environment = {f"EIGENHEAD_{name.upper()}": value for name, value in chosen.items()} | dict(variables or {})
    service = RunningService(data, environment, free_port(), worker, forked)
    running.append(service)
    try:
        service.start(terminal)
        yield service
    except BaseException:  # of a test; what a test of its fixture's service raises does not come by here
        sys.stdout.write(f"{service.log}:\n{service.log_end()}")
        raise
    finally:
        service.stop()
        running.remove(service)


@contextmanager
def served_client(data: Path, **settings: Any) -> Iterator[tuple[RunningService, httpx.Client]]:
    """A running service, and a client of it."""
    with running_service(data, **settings) as service, httpx.Client(base_url=service.url, timeout=120) as client:
        yield service, client


def worker_pids(service: RunningService) -> list[int]:
    """Worker processes of a service's data folder."""
    return pids_of(service, lambda words: b"worker" in words)


def pids_of(service: RunningService, fits: Callable[[list[bytes]], bool]) -> list[int]:
    """Processes of a service's data folder, told by their environment, whose command fits."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = ((folder / name).read_bytes() for name in ("cmdline", "environ"))
        except OSError:
            continue
        ours = f"EIGENHEAD_DATA={service.data}\0".encode() in environment + b"\0"
        if ours and fits(command.rstrip(b"\0").split(b"\0")):
            found.append(int(folder.name))
    return found


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def awaited(read: Callable[[], T], fits: Callable[[T], object] = bool, timeout_s: float = 120.0) -> T:
    """What ``read`` returns once it fits."""
    deadline = time.monotonic() + timeout_s
    while not fits(found := read()):
        assert time.monotonic() < deadline, found
        time.sleep(0.05)
    return found


def await_state(client: httpx.Client, job: str, states: tuple[str, ...], timeout_s: float = 120.0) -> dict:
    return awaited(lambda: client.get(f"/v1/jobs/{job}").json(), lambda found: found["state"] in states, timeout_s)


def await_calibration(client: httpx.Client, calibration: str, timeout_s: float = 400.0) -> dict:
    path, waiting = f"/v1/calibrations/{calibration}", ("queued", "running")
    return awaited(lambda: client.get(path).json(), lambda found: found["state"] not in waiting, timeout_s)


def await_true(condition: Callable[[], object], timeout_s: float = 120.0) -> None:
    awaited(condition, timeout_s=timeout_s)


def small_capture(folder: Path, seed: int = 0, cameras: int = 3, size: int = 24) -> Path:
    """A capture folder of noise: what it shows does not matter here."""
    rng = np.random.default_rng(seed)
    poses = [RigidTransform(np.eye(3), np.array([40.0 * i, 0.0, 1000.0])) for i in range(cameras)]
    intrinsics = Intrinsics(size, size, 1.25 * size, 1.25 * size, size / 2, size / 2)
    rig = Rig(tuple(Camera(f"cam{i:02}", intrinsics, pose) for i, pose in enumerate(poses)))
    images = {name: rng.integers(0, 256, (size, size, 3), dtype=np.uint8) for name in rig.names}
    plates = {name: (rng.integers(0, 256, (size, size, 3), dtype=np.uint8),) for name in rig.names}
    write_capture(folder, Capture(images, plates), rig)
    return folder


def packed_capture(folder: Path, seed: int = 0) -> Path:
    """An archive of ``small_capture`` in ``folder``."""
    small_capture(folder / f"capture{seed}", seed)
    pack_folder(folder / f"capture{seed}", folder / f"capture{seed}.tar")
    return folder / f"capture{seed}.tar"


def uploaded_capture(service: RunningService, folder: Path, seed: int = 0) -> str:
    """The id that the service gave to a small capture, labelled with its seed."""
    with httpx.Client(base_url=service.url, timeout=60) as http:
        answer = upload(http, packed_capture(folder, seed).read_bytes(), label=f"subject {seed}")
    assert answer.status_code == 201, answer.text
    return answer.json()["id"]


def packed(folder: Path) -> bytes:
    """An archive of a capture folder."""
    pack_folder(folder, folder.with_suffix(".tar"))
    return folder.with_suffix(".tar").read_bytes()


def stored(service: RunningService) -> list[str]:
    """Everything that lies in the data folder of captures and jobs."""
    kinds = ("captures", "jobs", "incoming", "uploads", "trash", "set-aside")
    return sorted(p.relative_to(service.data).as_posix() for kind in kinds for p in (service.data / kind).rglob("*"))


def upload(http: httpx.Client, data: bytes, path: str = "/v1/captures/uploads", **fields: str) -> httpx.Response:
    return http.post(path, files={"file": ("capture.tar", data)}, data=fields)


def imported(service: RunningService, url: str) -> httpx.Response:
    return httpx.post(service.url + "/v1/captures/imports", json={"url": url, "label": "Anna"}, timeout=60)


def kill_workers(service: RunningService) -> None:
    for pid in worker_pids(service):
        os.kill(pid, signal.SIGKILL)


def made_head(http: httpx.Client, folder: Path, seed: int = 0, **fields: str) -> str:
    """The job that made a head of a small capture."""
    capture = upload(http, packed_capture(folder, seed).read_bytes(), **fields).json()["id"]
    job = http.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
    await_state(http, job, ("succeeded",))
    return job

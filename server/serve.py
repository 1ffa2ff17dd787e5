"""``eigenhead serve``: the service and, unless told otherwise, a worker process beside it."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import structlog
import uvicorn

from server.access import Keys, check_address
from server.app import create_app
from server.database import open_database
from server.settings import ServiceSettings

WORKER_PAUSE_S = 1.0  # before a worker that died is started again; doubled up to a minute

log = structlog.get_logger()


class WorkerProcess:
    """A worker that lives as long as this process: it is started again when it dies, and ends when our end of its
    standard input does, also if we are killed."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._environment = os.environ | settings.environment()
        self._stop = threading.Event()
        self._process = self._start()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        process = self._process
        if process.stdin is not None:
            process.stdin.close()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._thread.join()

    def _start(self) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", "server.cli", "worker", "--until-eof"]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sys.__stderr__, env=self._environment)

    def _watch(self) -> None:
        pause = WORKER_PAUSE_S
        while not self._stop.is_set():
            began = time.monotonic()
            code = self._process.wait()
            if self._stop.is_set():
                return
            pause = WORKER_PAUSE_S if time.monotonic() - began > 60 else min(60.0, pause * 2)
            log.error("worker died, starting another", status=code, pause_s=pause)
            if self._stop.wait(pause if pause > WORKER_PAUSE_S * 2 else 0.1):
                return
            if self._process.stdin is not None:
                self._process.stdin.close()
            self._process = self._start()


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((host, port))
    sock.listen(1024)
    return sock


def run_service(settings: ServiceSettings, *, worker: bool = True, ready: Callable[[str], None] | None = None) -> None:
    """Serves until a signal. ``ready`` is told the address once requests are answered.

    Raises KeylessAddress, and OSError where the address is taken.
    """
    settings.data.mkdir(parents=True, exist_ok=True)
    engine = open_database(settings)
    check_address(settings.host, Keys(engine))
    engine.dispose()
    sock = listen(settings.host, settings.port)
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    url = f"http://{host}:{sock.getsockname()[1]}"
    server = uvicorn.Server(
        uvicorn.Config(
            create_app(settings), log_config=None, lifespan="on", timeout_graceful_shutdown=3, access_log=False
        )
    )
    beside = WorkerProcess(settings) if worker else None
    try:
        if ready is not None:
            threading.Thread(target=_tell, args=(server, url, ready), daemon=True).start()
        server.run(sockets=[sock])
    finally:
        if beside is not None:
            beside.close()


def _tell(server: uvicorn.Server, url: str, ready: Callable[[str], None]) -> None:
    while not server.started and not server.should_exit:
        time.sleep(0.02)
    ready(url)

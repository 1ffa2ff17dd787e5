"""Implements ``eigenhead serve``: runs the service and, by default, a worker process beside it."""

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING

import structlog

from rig.formats.rig_toml import read_rig_config
from server.address import listen
from server.processes import python_command, python_environment
from server.services.keys import Keys, check_address
from server.settings import ServiceSettings
from server.storage.database import check_pages, open_database

if TYPE_CHECKING:
    import uvicorn

BACKLOG = 128  # connections taken in one turn of the loop: fewer than connections.DESCRIPTORS_SPARED
WORKER_PAUSE_S = 1.0  # before a worker that died is started again; doubled up to a minute

log = structlog.get_logger()


class WorkerProcess:
    """Keeps a worker process running as long as this process lives.

    A worker that dies is started again, after a pause that grows with each early death. The worker ends when its
    standard input closes, and therefore also if this process is killed.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self._environment = python_environment() | settings.environment()
        self._stop = threading.Event()
        self._process = self._start()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def expect_end(self) -> None:
        """Stops restarting the worker. Callers call the method when a signal ends this process, because the signal may
        have gone to the whole process group or container and may also end the worker."""
        self._stop.set()

    def close(self) -> None:
        """Ends the worker by closing its standard input, and kills it if it has not ended after 10 s."""
        self.expect_end()
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
        """Starts a worker with SIGINT blocked, which its children inherit. Ctrl-C reaches all processes of a terminal;
        only the service reacts to it and then ends its worker."""
        command = python_command("cli", "worker", "--until-eof")
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sys.__stderr__, env=self._environment)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)

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


def run_service(settings: ServiceSettings, *, worker: bool = True, ready: Callable[[str], None] | None = None) -> None:
    """Serves requests until a signal ends the process. Calls ``ready`` with the address once the service answers.

    Faults of the rig's file, the address and the database are reported before heavy modules are loaded. Raises
    InputError for the rig's file, AddressTaken, DatabaseUnavailable, and KeylessAddress if other machines could reach a
    service without keys.
    """
    if settings.rig is not None:
        read_rig_config(settings.rig)
    sock = listen(settings.host, settings.port)
    engine = open_database(settings)
    check_pages(engine, settings.place)
    check_address(settings, Keys(engine))
    engine.dispose()
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    url = f"http://{host}:{sock.getsockname()[1]}"
    _serve(settings, sock, worker, lambda: ready and ready(url))


def _serve(settings: ServiceSettings, sock: socket.socket, worker: bool, ready: Callable[[], object]) -> None:
    import uvicorn

    from server.http.app import create_app
    from server.http.connections import BoundedConnection

    mount = None
    if settings.console:
        from server.console.mount import mount_console as mount  # NiceGUI takes longer to import than all the rest
    config = uvicorn.Config(
        create_app(settings, mount),
        http=BoundedConnection,
        backlog=BACKLOG,
        log_config=None,
        lifespan="on",
        timeout_graceful_shutdown=3,
        access_log=False,
    )

    class Server(uvicorn.Server):
        interrupted = False

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            self.interrupted = self.interrupted or sig == signal.SIGINT
            if beside is not None:
                beside.expect_end()
            super().handle_exit(sig, frame)

    server = Server(config)
    beside = WorkerProcess(settings) if worker else None
    try:
        threading.Thread(target=_tell, args=(server, ready), daemon=True).start()
        server.run(sockets=[sock])
    finally:
        if beside is not None:
            beside.close()
    if server.interrupted:  # asyncio may lose the signal that uvicorn raises again at its end
        raise KeyboardInterrupt


def _tell(server: "uvicorn.Server", ready: Callable[[], object]) -> None:
    while not server.started and not server.should_exit:
        time.sleep(0.02)
    if server.started:
        ready()

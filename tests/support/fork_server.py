"""Starts the product's processes (service, worker, its children, commands) by fork in place of exec.

Importing the product takes three to six processor seconds in each process; here one process of a test session imports
it once and forks. ``Popen`` is ``subprocess.Popen`` but for the start: the new process is a child of the caller, with
the arguments, environment, folder, files, signal mask, session and process group that exec would have given to it, and
/proc shows the same command and variables. It runs the module as ``python -m`` does and ends as an interpreter ends.
Signals, wait and kill are those of a real process because it is one. A service that was started so starts its worker,
and the worker its children, in the same way.

What needs exec itself is started by ``subprocess``: a program other than the product's modules, a ``preexec_fn``, other
variables of the interpreter, and a measurement of coverage.
"""

import atexit
import contextlib
import ctypes
import fcntl
import functools
import gc
import importlib
import os
import pickle
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
MODULES = ("server.cli", "server.tasks.child", "tests.support.pinned_batch")
IMPORTED = (
    "server.cli.main",
    "uvicorn",
    "uvicorn.lifespan.on",
    "uvicorn.loops.auto",
    "uvicorn.protocols.http.auto",
    "uvicorn.protocols.websockets.auto",
    "server.http.app",
    "server.http.serve",
    "server.worker.worker",
    "server.tasks.child",
    "pipeline.reconstruct",
    "tests.support.pinned_batch",
    "tests.support.tiny",
)
CONSOLE = (
    "server.console.mount",
    "server.console.media",
    *(
        f"server.console.pages.{page.stem}"
        for page in sorted((ROOT / "server/console/pages").glob("*.py"))
        if page.stem != "__init__"
    ),
)
# Read when the interpreter starts or a library is imported: with others than the fork server's, a process is exec'd.
READ_AT_START = ("PYTHON", "LD_", "LC_", "LANG", "OPENBLAS", "OMP_", "NUMBA_", "NICEGUI", "OPENCV", "COVERAGE")
TITLE_BYTES, VARIABLES_BYTES = 8192, 65536  # the room in which /proc shows a process's command and variables
PR_SET_CHILD_SUBREAPER = 36  # of sys/prctl.h
MESSAGE_BYTES = 1 << 18  # a packet of a Unix socket, the environment in it

_one_request = threading.Lock()
_inherited: "socket.socket | None" = None  # of a forked process: the way to the server that starts its children

_status: object = None  # of a forked process that has run its module


def _forkable(command: object, environment: dict[str, str]) -> "tuple[str, list[str]] | None":
    """Module and arguments of a command that a fork can stand for, else None."""
    if isinstance(command, str | bytes | os.PathLike) or not isinstance(command, Sequence):
        return None
    words = [os.fspath(word) for word in command]
    if not words or words[0] != sys.executable:
        return None
    words = words[2:] if words[1:2] == ["-P"] else words[1:]
    if words[:1] != ["-m"] or words[1:2] not in ([module] for module in MODULES):
        return None
    path = [folder for folder in environment.get("PYTHONPATH", "").split(os.pathsep) if folder]
    same = _start_variables(environment) == _start_variables(dict(os.environ))
    measured = any(name.startswith("COVERAGE_PROCESS") for name in environment)
    if not same or measured or any(folder != str(ROOT) for folder in path):
        return None
    return words[1], words[2:]


def _start_variables(environment: dict[str, str]) -> dict[str, str]:
    read = {name: value for name, value in environment.items() if name.startswith(READ_AT_START)}
    read.pop("PYTHONPATH", None)
    return {"OPENBLAS_NUM_THREADS": "1", "OPENCV_LOG_LEVEL": "SILENT"} | read  # as the command sets them


ExecPopen = subprocess.Popen


class Popen(ExecPopen):
    """Is ``subprocess.Popen`` whose process, where that can be, is forked and not exec'd."""

    def _execute_child(self, args: Any, executable: Any, preexec_fn: Any, *rest: Any) -> None:
        _, pass_fds, cwd, env, _, _, shell, p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite, *more = rest
        new_session, group = more[-2:]
        environment = dict(os.environ if env is None else env)
        forkable = None if shell or executable or preexec_fn or group != -1 else _forkable(args, environment)
        if forkable is None:
            super()._execute_child(args, executable, preexec_fn, *rest)  # type: ignore[misc]
            return
        files = [0 if p2cread == -1 else p2cread, 1 if c2pwrite == -1 else c2pwrite, 2 if errwrite == -1 else errwrite]
        request = {
            "module": forkable[0],
            "arguments": forkable[1],
            "title": [os.fspath(word) for word in args],
            "environment": environment,
            "folder": os.fspath(cwd or Path.cwd()),
            "files": [0, 1, 2, *pass_fds],
            "mask": signal.pthread_sigmask(signal.SIG_BLOCK, []),
            "session": bool(new_session),
        }
        self.pid = _forked(request, [*files, *pass_fds])  # type: ignore[misc]
        self._child_created = True  # type: ignore[attr-defined]
        self._close_pipe_fds(p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite)  # type: ignore[attr-defined]


def run(command: Sequence[str], timeout_s: float, **options: Any) -> "subprocess.CompletedProcess[str]":
    """Is ``subprocess.run`` with output captured as text, by the ``Popen`` of this module."""
    with Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options) as process:
        try:
            out, errors = process.communicate(timeout=timeout_s)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, errors)


def _forked(request: dict[str, Any], files: list[int]) -> int:
    """The pid of a new child of this process. The server's own child forks it and ends, and the kernel gives it to the
    nearest ancestor that takes orphans, which this process is meanwhile."""
    with _one_request:
        server = _inherited or _server()
        _take_orphans(True)
        try:
            socket.send_fds(server, [pickle.dumps(request)], files)
            answer = server.recv(MESSAGE_BYTES)
        finally:
            _take_orphans(False)
    if not answer.isdigit():
        raise ChildProcessError(answer.decode() or "the fork server has ended")
    return int(answer)


def _take_orphans(take: bool) -> None:
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, int(take), 0, 0, 0):
        raise OSError(ctypes.get_errno(), "PR_SET_CHILD_SUBREAPER")


@functools.cache
def _server() -> socket.socket:
    """The fork server of this process; it ends with it."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "TMPDIR", "XDG_CACHE_HOME") if name in os.environ}
    room = {"ROOM": "-" * VARIABLES_BYTES}
    code = f"from tests.support.fork_server import serve; serve({theirs.fileno()})"
    with theirs:
        process = ExecPopen(
            [sys.executable, "-P", "-c", code, "-" * TITLE_BYTES],
            env=kept | _start_variables(dict(os.environ)) | {"PYTHONPATH": str(ROOT)} | room,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
        )
    atexit.register(process.wait)
    atexit.register(process.kill)  # the last is called first
    return ours


def serve(number: int) -> None:
    """Imports the product, then forks for each request that comes by the socket with this file number."""
    atexit.register(_end_without_teardown)  # first, so that it is called last
    _import(IMPORTED)
    server = socket.socket(fileno=number)
    while True:
        _ignore_signals(signal.SIG_IGN)  # of a terminal: the server ends with the process that asks it
        request, files = _await_request(server)
        server.detach()  # its number is closed, or another file's, from here on
        _take_on(request, files)
        if request["module"] == "server.tasks.child":  # it starts nothing
            break
        ours, server = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if os.fork():
            server.close()
            global _inherited
            _inherited = ours
            subprocess.Popen = Popen  # type: ignore[misc]
            break
        ours.close()
        _write_title(["fork-server"], {})  # so that nobody takes it for the process that it serves
        nothing = os.open(os.devnull, os.O_RDWR)
        _place_files(dict.fromkeys((0, 1, 2), nothing) | {server.fileno(): server.fileno()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the module was imported before
        global _status
        try:
            runpy.run_module(request["module"], run_name="__main__", alter_sys=True)
            _status = 0
        except SystemExit as end:
            _status = end.code or 0
            raise


def _end_without_teardown() -> None:
    """Ends a forked process after its threads and exit functions. Teardown of modules would copy all the memory that it
    shares with the server, 0.15 s of CPU time. What fails here is left to the interpreter's own end."""
    with contextlib.suppress(Exception):
        if isinstance(_status, int):
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(_status)


def _import(modules: Sequence[str]) -> None:
    if not sys.modules.keys() >= set(modules):
        for module in modules:
            importlib.import_module(module)
        gc.collect()
        gc.freeze()  # so that a collection does not copy the pages which all processes share


def _ignore_signals(handler: Any) -> None:
    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


def _await_request(server: socket.socket) -> "tuple[dict[str, Any], list[int]]":
    """Forks for each request; returns in the forked process."""
    while True:
        message, files = b"", []
        with contextlib.suppress(ConnectionError):
            message, files, _, _ = socket.recv_fds(server, MESSAGE_BYTES, 64)
        if not message:
            os._exit(0)
        request = pickle.loads(message)
        if request["environment"].get("EIGENHEAD_CONSOLE") == "true" and "serve" in request["arguments"]:
            _import(CONSOLE)
        threads = [(task / "comm").read_text().strip() for task in Path("/proc/self/task").iterdir()]
        if len(threads) != 1:
            server.send(f"the fork server has more than one thread: {', '.join(threads)}".encode())
            os._exit(1)
        pid_reader, pid_writer = os.pipe()
        between = os.fork()
        if between == 0:
            between = os.getpid()
            pid = os.fork()
            if pid:
                os.write(pid_writer, b"%d" % pid)
                os._exit(0)
            while os.getppid() == between:
                time.sleep(0.0005)
            return request, files
        os.waitpid(between, 0)  # from now on the process belongs to whoever asked for it
        pid = os.read(pid_reader, 32)
        os.close(pid_writer)
        os.read(pid_reader, 1)  # until the process has closed its end, as the last of what it takes on
        server.send(pid)
        for file in (pid_reader, *files):
            os.close(file)


def _take_on(request: dict[str, Any], files: list[int]) -> None:
    """Takes on what exec would have given to the process."""
    if request["session"]:
        os.setsid()
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    _write_title(request["title"], request["environment"])
    sys.argv = [request["module"], *request["arguments"]]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, request["mask"])
    _place_files(dict(zip(request["files"], files, strict=True)))


def _place_files(files: dict[int, int]) -> None:
    """Gives open files the numbers that are ``files``' keys, and closes all others."""
    beyond = max(*files, *files.values()) + 1
    raised = {number: fcntl.fcntl(file, fcntl.F_DUPFD_CLOEXEC, beyond) for number, file in files.items()}
    for number, file in raised.items():
        os.dup2(file, number)  # which exec would leave open
    for number in [int(entry.name) for entry in Path("/proc/self/fd").iterdir()]:
        if number not in files:
            with contextlib.suppress(OSError):  # the listing's own
                os.close(number)


def _write_title(command: list[str], environment: dict[str, str]) -> None:
    """Writes command and variables where /proc finds those of exec. Nothing else reads that memory: the variables
    have just been set anew, elsewhere."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    variables = [f"{name}={value}" for name, value in environment.items()]
    for words, start, end in ((command, *fields[45:47]), (variables, *fields[47:49])):
        room = int(end) - int(start)
        content = b"".join(os.fsencode(word) + b"\0" for word in words)[: room - 1]
        ctypes.memset(int(start), 0, room)
        ctypes.memmove(int(start), content, len(content))

"""Implements a child process that stays alive and does one task after the other.

Heavy work (reconstruction, checking images, rendering the simulated studio) runs outside the process that answers
requests or sends a worker's heartbeat. In child processes, neither a GL context nor Python's interpreter lock delays
the parent, a crash in native code costs one job only, and a task that does not react to a cancellation can be killed.

The child runs this module, is connected to its parent by a socket, and ends when the socket closes, so it never
outlives the parent.
"""

import importlib
import os
import pickle
import queue
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from multiprocessing.connection import Connection
from types import MappingProxyType
from typing import Any, Concatenate, ParamSpec, TypeVar

from rig.errors import DISK_FULL, Cancelled, EigenheadError, InputError
from rig.messages.message import Message, compose, message_of, verbatim
from rig.progress import Progress
from server.processes import SERVER, python_command, python_environment

PATIENCE_S = 0.5  # between asking a piece of work to stop and killing it: a cancellation takes effect within a second
REPORT_EVERY_S = 0.05

P = ParamSpec("P")
T = TypeVar("T")
CANCELLED: ContextVar[Callable[[], bool]] = ContextVar(
    "cancelled", default=lambda: False
)  # asked where no other is named
CALLER: ContextVar[str] = ContextVar("caller", default="")  # for whom a child of a pool works
STOP = b""


class WorkFailed(EigenheadError):
    """Reports that work in a child process failed. ``kind`` is the name of an error class of this project, or
    "disk-full", "out-of-memory", "killed" (by signal 9), "crash" or "bug". A bug has a ``trace`` for the log."""

    def __init__(
        self, kind: str, message: Message | str, faults: Iterable[Message | str] = (), trace: str = ""
    ) -> None:
        super().__init__(message)
        self.kind, self.trace = kind, trace
        self.faults = tuple(message_of(fault) for fault in faults)


class WorkerContext:
    """Keeps resources of a child process, such as a model or a renderer, from one task to the next."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._things: dict[str, object] = {}

    def keep(self, name: str, make: Callable[[], Any]) -> Any:
        """Returns the resource called ``name``. The first call makes the resource by ``make``; if it is a context
        manager, it is entered and its value returned."""
        if name not in self._things:
            thing: Any = make()
            self._things[name] = self._stack.enter_context(thing) if hasattr(thing, "__exit__") else thing
        return self._things[name]

    def close(self) -> None:
        """Closes all resources, the newest first."""
        self._things.clear()
        self._stack.close()


class Child:
    """Runs tasks in one child process, which starts at the first task. Two threads must not use a child at once.

    ``variables``: environment variables of the child, which override those of this process; ``memory``: bytes that it
    may allocate (0: any number), beyond which its work fails as "out-of-memory".
    """

    def __init__(self, niceness: int = 0, variables: Mapping[str, str] = MappingProxyType({}), memory: int = 0) -> None:
        self._niceness, self._variables, self._memory = niceness, dict(variables), memory
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    def remote(
        self,
        work: Callable[Concatenate[WorkerContext, Progress, P], T],
        *,
        report: Progress = lambda stage, fraction: None,
        cancelled: Callable[[], bool] | None = None,
    ) -> Callable[P, T]:
        """Returns a function that runs ``work`` in the child: ``child.remote(work)(name=value)`` calls ``work(context,
        report, name=value)`` there. ``work`` must be a module's function, since only its name is sent.

        The returned function raises Cancelled within a second after ``cancelled()`` returned True; InputError or
        WorkFailed if ``work`` raised; and WorkFailed of the kind "killed" or "crash" if the child died.
        """

        def call(*arguments: P.args, **named: P.kwargs) -> T:
            return self._run(pickle.dumps((work, arguments, named)), report, cancelled or CANCELLED.get())

        return call

    def _run(self, request: bytes, report: Progress, cancelled: Callable[[], bool]) -> Any:
        connection = self._started()
        try:
            connection.send_bytes(request)
            return self._await(connection, report, cancelled)
        except (EOFError, OSError) as error:
            code = self._kill()
            how = compose("ended-by-signal", number=-code) if code < 0 else compose("ended-with-status", status=code)
            kind = "killed" if code == -signal.SIGKILL else "crash"
            raise WorkFailed(kind, compose("work-crashed", how=how)) from error
        except BaseException:
            if self._connection is not None and not self._idle:
                self._kill()
            raise

    @property
    def runs(self) -> bool:
        """Returns whether the child process is alive, so that the next task begins at once."""
        return self._process is not None

    def close(self) -> None:
        """Kills the child process. The next task starts a new process."""
        self._kill()

    def start(self) -> None:
        """Starts the child process before the first task needs it."""
        self._started()

    def _started(self) -> Connection:
        self._idle = False
        if self._connection is not None and self._process is not None and self._process.poll() is None:
            return self._connection
        self._kill()
        ours, theirs = socket.socketpair()
        command = python_command("tasks.child", str(theirs.fileno()), str(self._niceness), str(self._memory))
        with theirs:
            environment = python_environment() | self._variables
            self._process = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=2, env=environment
            )
        self._connection = Connection(ours.detach())
        return self._connection

    def _await(self, connection: Connection, report: Progress, cancelled: Callable[[], bool]) -> Any:
        deadline: float | None = None
        while True:
            if connection.poll(0.05):
                kind, *rest = connection.recv()
                if kind == "report":
                    report(*rest)
                    continue
                self._idle = True
                if kind == "done":
                    return rest[0]
                raise _error(*rest)
            if deadline is None and cancelled():
                connection.send_bytes(STOP)
                deadline = time.monotonic() + PATIENCE_S
            if deadline is not None and time.monotonic() > deadline:
                self._kill()
                raise Cancelled

    def _kill(self) -> int:
        process, self._process = self._process, None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if process is None:
            return 0
        process.kill() if process.poll() is None else None
        return process.wait()


class ChildProcessPool:
    """Lends a fixed number of child processes to many threads. Each child serves one thread at a time.

    A child whose task is abandoned is killed, and its successor needs a second to start: each caller gets the child
    that worked for the same caller last, so that only callers who abandon tasks wait.
    """

    def __init__(self, count: int, niceness: int = 0, memory: int = 0) -> None:
        self._all = [Child(niceness, memory=memory) for _ in range(count)]
        self._free = {child: "" for child in self._all}  # and for whom each of them worked last
        self._freed = threading.Condition()

    @contextmanager
    def one(self, timeout_s: float | None = None) -> Iterator[Child]:
        """Yields a child that no other thread uses during the block: the one last used by ``CALLER``, an unused one, or
        a running one. Raises queue.Empty if no child is free within ``timeout_s`` seconds."""
        caller = CALLER.get()
        with self._freed:
            if not self._freed.wait_for(lambda: self._free, timeout_s):
                raise queue.Empty
            whose = self._free
            child = min(whose, key=lambda each: (whose[each] != caller, whose[each] != "", not each.runs))
            del self._free[child]
        try:
            yield child
        finally:
            with self._freed:
                self._free[child] = caller
                self._freed.notify()

    def close(self) -> None:
        """Kills all child processes."""
        for child in self._all:
            child.close()


def _error(kind: str, message: Message, subject: str, faults: tuple[Message, ...], trace: str) -> EigenheadError:
    if kind == "Cancelled":
        return Cancelled()
    return InputError(subject, faults) if kind == "InputError" else WorkFailed(kind, message, faults, trace)


def _described(error: BaseException) -> tuple[str, str, Message, str, tuple[Message, ...], str]:
    if isinstance(error, InputError):
        return "failed", "InputError", error.message, error.subject, error.faults, ""
    if isinstance(error, EigenheadError):
        faults = getattr(error, "faults", ())
        messages = tuple(fault if isinstance(fault, Message) else verbatim(str(fault)) for fault in faults)
        return "failed", type(error).__name__, error.message, "", messages, ""
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return "failed", "disk-full", compose("disk-full"), "", (), ""
    if _lacks_memory(error):
        return "failed", "out-of-memory", compose("out-of-memory"), "", (), ""
    trace = "".join(traceback.format_exception(error))
    return "failed", "bug", verbatim(f"{type(error).__name__}: {error}"[:500]), "", (), trace


def _lacks_memory(error: BaseException) -> bool:
    """Returns whether memory was refused: by Python, by OpenCV (StsNoMem, -4), or for a thread's stack."""
    no_thread = isinstance(error, RuntimeError) and "start new thread" in str(error)
    return isinstance(error, MemoryError) or getattr(error, "code", None) == -4 or no_thread


def serve(connection: Connection) -> None:
    """Runs the main loop of a child process; does not return. The main thread does the tasks, as a GL context requires.
    A second thread receives requests and cancellations, and ends the process when the parent process has ended."""
    requests: queue.Queue[bytes] = queue.Queue()
    stop = threading.Event()

    def listen() -> None:
        with suppress(EOFError, OSError):
            while True:
                message = connection.recv_bytes()
                if message == STOP:
                    stop.set()
                else:
                    requests.put(message)
        os._exit(0)  # the parent is gone: nobody waits for the result

    threading.Thread(target=listen, daemon=True).start()
    context = WorkerContext()
    while True:
        request = requests.get()
        stop.clear()
        try:
            work, arguments, named = pickle.loads(request)
            answer = ("done", work(context, _reporter(connection, stop), *arguments, **named))
        except BaseException as error:
            answer = _described(error)
        connection.send(answer)


def _reporter(connection: Connection, stop: threading.Event) -> Progress:
    last: tuple[str, float] = ("", 0.0)

    def report(stage: str, fraction: float) -> None:
        nonlocal last
        if stop.is_set():
            raise Cancelled
        now = time.monotonic()
        if stage != last[0] or now - last[1] > REPORT_EVERY_S:
            last = (stage, now)
            connection.send(("report", stage, float(fraction)))

    return report


def function_at(address: str) -> Callable[..., Any]:
    """Returns the function that "module:name" names. A module name that begins with a dot is relative to the package
    ``server``."""
    module, _, name = address.partition(":")
    return getattr(importlib.import_module(module, SERVER), name)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a terminal; the parent ends its children
    os.nice(int(sys.argv[2]))
    if memory := int(sys.argv[3]):
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    serve(Connection(int(sys.argv[1])))

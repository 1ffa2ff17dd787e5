"""Runs a batch: each worker processes its captures in one child process, which keeps models and compiled loops.

A crash of a child, or a fault of a capture, fails that capture only. If this process ends at any moment, every result
is complete or absent, and the next run removes what was left unfinished."""

import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Concatenate, Literal, Protocol

from rig.errors import DISK_FULL, Cancelled, EigenheadError, InputError
from rig.messages.message import Message, compose
from rig.progress import Progress
from server.batch.captures import WHOLE, Shard, capture_sha256
from server.batch.folder import BatchFolder, FailureRecord, Origin
from server.tasks.child import Child, WorkerContext, WorkFailed
from server.tasks.progress import JobProgress
from server.tasks.reconstruct import reconstruct_beside

if TYPE_CHECKING:
    from server.batch.plan import BatchTask


def failure_of(error: EigenheadError | OSError, capture: Path, origin: Origin | None) -> FailureRecord:
    """Returns the failure record for an error. ``origin``: None if the capture could not be read."""
    if isinstance(error, WorkFailed):
        kind = "crash" if error.kind == "killed" else error.kind
        return FailureRecord(kind, _of_work(error), error.faults, origin, error.trace)
    if isinstance(error, EigenheadError):
        kind = "input" if isinstance(error, InputError) else "refused"
        return FailureRecord(kind, error.message, getattr(error, "faults", ()), origin)
    if error.errno in DISK_FULL:
        return FailureRecord("disk-full", compose("batch-disk-full"), (), origin)
    reason = error.strerror or str(error)
    if origin is None:
        message = compose("batch-capture-unreadable", path=str(capture), reason=reason)
        return FailureRecord("input", message, (), origin)
    message = compose("batch-result-unwritable", path=str(error.filename or ""), reason=reason)
    return FailureRecord("unwritable", message, (), origin)


def _of_work(error: WorkFailed) -> Message:
    if error.kind == "killed":
        return compose("batch-worker-killed")
    if error.kind == "disk-full":
        return compose("batch-disk-full")
    if error.kind == "out-of-memory":
        return compose("batch-out-of-memory")
    return error.message


EXAMINERS = 4  # captures whose files are compared at once: hashing releases the interpreter lock


@dataclass(frozen=True, slots=True)
class Outcome:
    """Holds how a capture ended: ``made`` by this process, ``kept`` from an earlier run, or ``failed``."""

    name: str
    state: Literal["made", "kept", "failed"]
    seconds: float = 0.0
    failure: FailureRecord | None = None


class Observer(Protocol):
    """Declares the methods that are called as a batch proceeds, from several threads but never two at a time."""

    def begin(self, pending: int) -> None:
        """Receives the number of captures to reconstruct, once, before the first one."""
        ...

    def report(self, name: str, share: float) -> None:
        """Receives the done fraction of a capture, 0 to 1; 0 means that its work begins."""
        ...

    def end(self, outcome: Outcome) -> None:
        """Receives the outcome of a capture."""
        ...


class BatchRun:
    """Makes the missing results of a batch, or of one part of it, in this process and its children."""

    def __init__(
        self,
        folder: BatchFolder,
        tasks: "Sequence[BatchTask]",
        *,
        workers: int,
        variables: Mapping[str, str],
        observer: Observer,
        shard: Shard = WHOLE,
        work: Callable[Concatenate[WorkerContext, Progress, ...], None] = reconstruct_beside,
    ) -> None:
        self._folder, self._tasks, self._workers, self._variables = folder, tasks, workers, variables
        self._observer, self._shard, self._work = observer, shard, work
        self._lock, self._stopped = threading.Lock(), threading.Event()
        self._pending: deque[BatchTask] = deque()
        self._outcomes: dict[str, Outcome] = {}

    def run(self, publish_table: Callable[[], object]) -> list[Outcome]:
        """Makes the missing results and returns the outcome of each capture, in the order of the tasks. If the process
        is killed, the next run makes the missing results.

        ``publish_table`` is called at the end, never by two processes at a time. Raises ShareTaken if another process
        works on the same part, and OSError if the folder cannot be written.
        """
        with self._folder.share(self._shard):
            self._examine()
            with self._lock:
                self._observer.begin(len(self._pending))
            self._work_off()
            with self._folder.table():
                publish_table()
        return [self._outcomes[task.capture.name] for task in self._tasks if task.capture.name in self._outcomes]

    def _examine(self) -> None:
        """Separates the captures whose results exist from those to be made."""

        def kept(task: "BatchTask") -> bool:
            origin = self._folder.origin(task.capture.name)
            try:
                return origin is not None and origin.is_of(self._origin(task, capture_sha256(task.capture.path)))
            except OSError:  # reported when the capture's turn comes
                return False

        with ThreadPoolExecutor(EXAMINERS) as pool:
            for task, done in zip(self._tasks, pool.map(kept, self._tasks), strict=True):
                if done:
                    self._outcomes[task.capture.name] = Outcome(task.capture.name, "kept")
                else:
                    self._pending.append(task)

    def _origin(self, task: "BatchTask", input_sha256: str) -> Origin:
        return Origin(input_sha256, task.settings_sha256, task.model_sha256, task.version)

    def _work_off(self) -> None:
        """Starts the workers, and stops them if this process is interrupted."""
        with ThreadPoolExecutor(self._workers, thread_name_prefix="worker") as pool:
            at_work = [pool.submit(self._serve) for _ in range(self._workers)]
            try:
                for done in as_completed(at_work):
                    done.result()
            except BaseException:
                self._stopped.set()
                raise

    def _serve(self) -> None:
        with closing(Child(variables=self._variables)) as child:
            while not self._stopped.is_set():
                with self._lock:
                    if not self._pending:
                        return
                    task = self._pending.popleft()
                    self._observer.report(task.capture.name, 0.0)
                try:
                    outcome = self._outcome(task, child)
                except Cancelled:
                    return
                with self._lock:
                    self._outcomes[outcome.name] = outcome
                    self._observer.end(outcome)

    def _outcome(self, task: "BatchTask", child: Child) -> Outcome:
        name, began = task.capture.name, time.monotonic()
        origin: Origin | None = None
        try:
            origin = self._origin(task, capture_sha256(task.capture.path))
            self._make(task, origin, child)
            return Outcome(name, "made", time.monotonic() - began)
        except Cancelled:
            raise
        except (EigenheadError, OSError) as error:
            failure = failure_of(error, task.capture.path, origin)
        with suppress(OSError):  # on a full disk only the terminal shows it
            self._folder.note_failure(name, failure)
        return Outcome(name, "failed", time.monotonic() - began, failure)

    def _make(self, task: "BatchTask", origin: Origin, child: Child) -> None:
        """Makes a result in a temporary folder and then publishes it. Raises Cancelled if this process is to stop."""
        name = task.capture.name
        self._folder.check_replaceable(name)
        attempt = self._folder.new_attempt(self._shard)
        progress = JobProgress(task.expected_s)

        def report(stage: str, fraction: float) -> None:
            progress.report(stage, fraction)
            with self._lock:
                self._observer.report(name, progress.progress())

        try:
            run = child.remote(self._work, report=report, cancelled=self._stopped.is_set)
            run(
                parent=os.getpid(),
                capture=str(task.capture.path.resolve()),
                result=str((attempt / "result").resolve()),
                scratch=str((attempt / "scratch").resolve()),
                model=task.model,
                settings=task.settings,
            )
            if capture_sha256(task.capture.path) != origin.input_sha256:
                raise InputError(name, [compose("batch-capture-changed")])
            self._folder.publish(name, attempt, origin)
        finally:
            shutil.rmtree(attempt, ignore_errors=True)


WORKER_BYTES = 2 << 30  # memory of one worker
"""Memory of a worker: 1.4 GB at the most in a default job of eleven cameras of 1024 x 768 (VmHWM of `eigenhead
reconstruct scan-a`), and half as much again for larger pictures."""
CGROUP = Path("/sys/fs/cgroup")


def worker_count(cores: int, free_bytes: int, captures: int) -> int:
    """Computes the default number of workers: one for each core if memory allows, fewer otherwise, and at least one."""
    return max(1, min(cores, free_bytes // WORKER_BYTES, captures))


def threads_of_worker(cores: int, workers: int) -> int:
    """Computes how many threads each worker's loops may use, so that all workers together use every core once."""
    return max(1, cores // workers)


def usable_cores() -> int:
    """Returns how many processors this process may use."""
    return len(os.sched_getaffinity(0))


def free_memory(meminfo: Path = Path("/proc/meminfo"), cgroup: Path | None = None) -> int:
    """Returns the free bytes of memory: of the machine, or of this process's control groups (such as a container's) if
    these have less."""
    free = [_available(meminfo)]
    group = _own_group() if cgroup is None else cgroup
    while group.is_relative_to(CGROUP) or cgroup is not None:
        limit, used = _number(group / "memory.max"), _number(group / "memory.current")
        if limit is not None and used is not None:
            free.append(max(0, limit - used))
        if cgroup is not None or group == CGROUP:
            break
        group = group.parent
    return min(free)


def _available(meminfo: Path) -> int:
    try:
        lines = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, KeyError):
        return WORKER_BYTES


def _own_group() -> Path:
    """Returns the folder of this process's control group, version 2."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return CGROUP
    group = next((line[3:] for line in lines if line.startswith("0::")), "/")
    return CGROUP / group.lstrip("/")


def _number(path: Path) -> int | None:
    """Returns the number in a file; None for "max", and if the file does not exist."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None

"""Records what each thread does and when, for the trace viewers of Chrome and Perfetto, and for the laboratory's
experiment ``scaling``.

Without an active trace nothing is recorded, and a call costs only one comparison. Stages, parts of stages, loops and
their slices are recorded as spans, each of one thread; spans of the same thread are nested. A stage that runs in a
separate thread has a ``background`` span; the stages that run at the same time have a ``foreground`` span of the same
name. Each span has wall clock time and CPU seconds, because on a busy machine only CPU seconds measure the work."""

import functools
import json
import math
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import count
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar

FORMAT = "eigenhead-trace/1"
JOB = "job"
Kind = Literal["job", "background", "foreground", "stage", "part", "loop", "slice"]
P = ParamSpec("P")
T = TypeVar("T")


class Trace:
    """Collects the spans of all threads of this process from the trace's creation on. A span is a named piece of work
    of one thread with its start and duration."""

    def __init__(self) -> None:
        self._began = time.perf_counter_ns()
        self._before_s = time.process_time()  # what a start loads, of which there are no spans
        self._events: list[dict[str, Any]] = []  # to append is atomic
        self._threads: dict[int, str] = {}
        self._loops = count()

    def new_loop(self) -> int:
        """Returns a number that no other loop of this trace has."""
        return next(self._loops)

    @contextmanager
    def span(self, kind: Kind, name: str, **arguments: object) -> Iterator[None]:
        """Records the ``with`` block as one span of the calling thread, also if the block raises an exception.

        ``cpu_s`` of the span is the CPU time of that thread. ``process_cpu_s`` is the CPU time of all threads during
        the span; loops and slices have none.
        """
        whole = kind not in ("loop", "slice")
        before_s, process_s = time.thread_time(), time.process_time() if whole else 0.0
        began = time.perf_counter_ns()
        try:
            yield
        finally:
            ended = time.perf_counter_ns()
            if whole:
                arguments["process_cpu_s"] = time.process_time() - process_s
            self._record(kind, name, began, ended, {"cpu_s": time.thread_time() - before_s} | arguments)

    def _record(self, kind: Kind, name: str, began: int, ended: int, arguments: dict[str, object]) -> None:
        thread = threading.get_native_id()
        self._threads.setdefault(thread, threading.current_thread().name)
        times = {"ts": (began - self._began) / 1000, "dur": (ended - began) / 1000}  # microseconds
        event = {"ph": "X", "cat": kind, "name": name, "pid": os.getpid(), "tid": thread}
        self._events.append(event | times | {"args": arguments})

    def encoded(self, *, threads: int) -> bytes:
        """Returns the trace as JSON for Chrome's viewer, one event per line: the names of the threads, then the spans
        in order of their start. ``threads`` is the number of threads that shared a loop."""
        header = {
            "format": FORMAT,
            "displayTimeUnit": "ms",
            "threads": threads,
            "cpus": len(os.sched_getaffinity(0)),
            "before_cpu_s": self._before_s,
            "peak_memory_mb": peak_memory_mb(),
        }
        names: list[dict[str, Any]] = [
            {"ph": "M", "name": "thread_name", "pid": os.getpid(), "tid": thread, "args": {"name": name}}
            for thread, name in self._threads.items()
        ]
        events = names + sorted(self._events, key=lambda event: (event["ts"], -event["dur"]))
        lines = ",\n".join(json.dumps(event) for event in events)
        return f'{json.dumps(header)[:-1]}, "traceEvents": [\n{lines}\n]}}\n'.encode()


def peak_memory_mb() -> float:
    """Returns the peak memory (MiB) of this process since its program was loaded; NaN if the operating system does not
    report it.

    ``getrusage`` would return more: its maximum survives ``exec``, so a child of a large process begins with the
    parent's (proc(5), ``VmHWM``).
    """
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.is_file() else None
    return int(found[1]) / 1024 if found else math.nan


_active: Trace | None = None


def active_trace() -> Trace | None:
    """Returns the trace that currently records the spans of all threads; None if there is none."""
    return _active


@contextmanager
def recorded(trace: Trace | None) -> Iterator[None]:
    """Records all spans of the ``with`` block into ``trace``, as one job; None records nothing. Only one job at a time
    can be recorded in a process."""
    global _active
    if trace is None:
        yield
        return
    earlier, _active = _active, trace
    try:
        with trace.span("job", JOB):
            yield
    finally:
        _active = earlier


def span(kind: Kind, name: str) -> AbstractContextManager[None]:
    """Returns a context manager that records its block as a span if a trace is active."""
    return nullcontext() if _active is None else _active.span(kind, name)


def traced(function: Callable[P, T]) -> Callable[P, T]:
    """Decorates a function so that each of its calls is recorded as a span, if a trace is active."""

    @functools.wraps(function)
    def timed(*arguments: P.args, **options: P.kwargs) -> T:
        with span("part", name_of(function)):
            return function(*arguments, **options)

    return timed


def name_of(function: Callable[..., object]) -> str:
    """Returns a function's name for a trace: its module within the pipeline, and its qualified name up to the outer
    function."""
    inner = function
    while isinstance(inner, functools.partial):
        inner = inner.func
    held = getattr(inner, "__qualname__", type(inner).__qualname__).split(".<locals>")[0]
    return f"{inner.__module__.removeprefix('pipeline.')}.{held}"

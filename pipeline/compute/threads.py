"""Runs slices of compiled loops in several threads.

Numba's option ``parallel`` takes five times as long to compile, and its OpenMP threads use CPU time while they wait:
while another process occupied one of two cores, a fit took 22 s instead of one. The module's threads sleep while they
wait, and are reused: starting threads for every loop took a third of a fit's time."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

from pipeline.compute.trace import Trace, active_trace, name_of
from rig.errors import WrongVariable
from rig.messages.message import compose

THREADS, MAX_THREADS = "EIGENHEAD_THREADS", 512
Result = TypeVar("Result")
SLICES = 8  # of a loop, at least: enough that threads end together
TRACED_THREADS = 16  # for how many threads a trace of one cuts its loops


def thread_count() -> int:
    """Returns how many threads share a loop: the variable EIGENHEAD_THREADS, or else the number of CPUs that this
    process may use. Raises WrongVariable if the variable is not a valid number."""
    requested = os.environ.get(THREADS, "").strip()
    if not requested:
        return len(os.sched_getaffinity(0))
    if not (requested.isascii() and requested.isdecimal() and 1 <= int(requested[:9]) <= MAX_THREADS):
        raise WrongVariable(THREADS, [compose("threads-wrong", value=f"{requested!r}", most=MAX_THREADS)])
    return int(requested)


def slice_count(threads: int) -> int:
    """Returns the largest number of slices into which a loop is divided for this number of threads. The number of
    slices is a power of two, so that more threads only subdivide the same slices."""
    return max(SLICES, 1 << (2 * threads - 1).bit_length())


def in_threads(count: int, work: Callable[[int, int], None]) -> None:
    """Runs ``work(first, last)`` over slices of ``range(count)`` in several threads. ``work`` is usually a compiled
    loop, which releases Python's interpreter lock.

    The result of ``work`` must not depend on how the range is divided. The calling thread processes slices as well. A
    helper thread that has not started when no slices remain is cancelled, so that the loop does not wait for it."""
    threads, trace = thread_count(), active_trace()
    if trace is not None:
        _traced(trace, count, work, name_of(work), threads)
    elif threads == 1:
        work(0, count)
    else:
        _share(cut(count, slice_count(threads)), work, threads)


def map_in_threads(work: Callable[[int], Result], count: int) -> list[Result]:
    """Returns ``work(k)`` for every k below ``count``, in order, computed in several threads."""
    found: dict[int, Result] = {}

    def take(first: int, last: int) -> None:
        for k in range(first, last):
            found[k] = work(k)

    threads, trace = thread_count(), active_trace()
    if trace is not None:
        _traced(trace, count, take, name_of(work), threads, single=True)
    else:
        _share(cut(count, count), take, threads)
    return [found[k] for k in range(count)]


def map_strips(work: Callable[[slice], None], size: int, rows: int) -> None:
    """Runs ``work`` on strips of at most ``rows`` rows of an image with ``size`` rows, in several threads."""
    map_in_threads(lambda k: work(slice(k * rows, min((k + 1) * rows, size))), -(-size // rows))


def cut(count: int, parts: int) -> list[tuple[int, int]]:
    """Divides ``range(count)`` into at most ``parts`` slices of nearly equal length. Returns each slice's first index
    and the index after its last one; no slice is empty unless ``count`` is 0."""
    parts = max(1, min(parts, count))
    return list(pairwise(count * k // parts for k in range(parts + 1)))


def _share(slices: list[tuple[int, int]], work: Callable[[int, int], None], threads: int) -> None:
    left = slices[::-1]

    def take() -> None:
        while left:
            try:
                first, last = left.pop()
            except IndexError:  # another thread took the last slice
                return
            work(first, last)

    helpers = [_pool(threads - 1).submit(take) for _ in range(min(threads, len(slices)) - 1)]
    try:
        take()
    except BaseException:
        left.clear()
        wait([helper for helper in helpers if not helper.cancel()])  # none may still work when the caller goes on
        raise
    for helper in helpers:
        if not helper.cancel():
            helper.result()


def _traced(
    trace: Trace, count: int, work: Callable[[int, int], None], name: str, threads: int, *, single: bool = False
) -> None:
    """Runs a loop and records a trace span for the loop and for each slice. With one thread the loop is divided as
    finely as for several threads, so that the trace shows how it could be shared."""
    loop = trace.new_loop()
    parts = count if single else slice_count(threads if threads > 1 else TRACED_THREADS)

    def timed(first: int, last: int) -> None:
        with trace.span("slice", name, loop=loop, first=first, last=last):
            work(first, last)

    with trace.span("loop", name, loop=loop, count=count, single=single):
        _share(cut(count, parts), timed, threads)


@contextmanager
def task_pool(threads: int | None = None) -> Iterator[ThreadPoolExecutor]:
    """Yields a pool of ``threads`` threads; None means the number of threads that share a loop. An active trace records
    the tasks as slices of one loop."""
    threads, trace = threads or thread_count(), active_trace()
    if trace is None:
        with ThreadPoolExecutor(threads) as pool:
            yield pool
        return
    loop = trace.new_loop()
    with trace.span("loop", "task_pool", loop=loop, count=0, single=True), TracedPool(threads, trace, loop) as pool:
        yield pool


class TracedPool(ThreadPoolExecutor):
    """Runs tasks in threads and records each task in a trace, as a slice of one loop."""

    def __init__(self, threads: int, trace: Trace, loop: int) -> None:
        super().__init__(threads, thread_name_prefix="tasks")
        self._trace, self._loop = trace, loop

    def submit(self, function: Callable[..., Result], /, *arguments: Any, **options: Any) -> Future[Result]:
        """Submits a task and records its run as a span of the trace."""

        def timed() -> Result:
            with self._trace.span("slice", name_of(function), loop=self._loop):
                return function(*arguments, **options)

        return super().submit(timed)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="slices")

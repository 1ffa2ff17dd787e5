"""Threads over slices of compiled loops.

Numba's own ``parallel`` compiles five times as long, and its OpenMP threads spin while they wait: where another process
held one of two cores, a fit took 22 s instead of one. These sleep, and they stay: starting them anew for every loop was
a third of a fit.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

from rig.errors import WrongVariable
from rig.messages.message import compose

THREADS, MAX_THREADS = "EIGENHEAD_THREADS", 512
Result = TypeVar("Result")
SLICES = 8  # of a loop: enough that threads end together


def thread_count() -> int:
    """Tells how many threads share a loop: EIGENHEAD_THREADS, else the CPUs that this process may use. Raises
    WrongVariable."""
    requested = os.environ.get(THREADS, "").strip()
    if not requested:
        return len(os.sched_getaffinity(0))
    if not (requested.isascii() and requested.isdecimal() and 1 <= int(requested[:9]) <= MAX_THREADS):
        raise WrongVariable(THREADS, [compose("threads-wrong", value=f"{requested!r}", most=MAX_THREADS)])
    return int(requested)


def in_threads(count: int, work: Callable[[int, int], None]) -> None:
    """Runs ``work(first, last)`` over slices of ``range(count)``; for compiled loops that let go of the interpreter.

    The caller takes slices like everyone else. A helper that has not begun when they are gone (all busy, or left behind
    by a fork) is called off, so that nobody waits for it.
    """
    threads = thread_count()
    if threads == 1:
        work(0, count)
        return
    parts = max(1, min(SLICES, count))
    slices = list(pairwise(count * k // parts for k in range(parts + 1)))[::-1]

    def take() -> None:
        while slices:
            try:
                first, last = slices.pop()
            except IndexError:  # another was quicker
                return
            work(first, last)

    helpers = [_pool(threads - 1).submit(take) for _ in range(threads - 1)]
    take()
    for helper in helpers:
        if not helper.cancel():
            helper.result()


def map_in_threads(work: Callable[[int], Result], count: int) -> list[Result]:
    """Returns ``work(k)`` of every k below ``count``, in order; shared out as by ``in_threads``."""
    found: dict[int, Result] = {}

    def take(first: int, last: int) -> None:
        for k in range(first, last):
            found[k] = work(k)

    in_threads(count, take)
    return [found[k] for k in range(count)]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="slices")

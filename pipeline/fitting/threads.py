"""Threads over slices of compiled loops.

Numba's own ``parallel`` compiles five times as long, and its OpenMP threads spin while they wait: where another process
held one of two cores, a fit took 22 s instead of one. These sleep.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

SLICES = 8  # of a loop: enough that threads end together


def in_threads(count: int, work: Callable[[int, int], None]) -> None:
    """``work(first, last)`` over slices of ``range(count)``; for compiled loops that let go of the interpreter."""
    cores = len(os.sched_getaffinity(0))
    if cores == 1:
        work(0, count)
        return
    ends = np.linspace(0, count, min(SLICES, count) + 1).astype(int).tolist()
    with ThreadPoolExecutor(cores) as pool:
        for done in [pool.submit(work, *ends[i : i + 2]) for i in range(len(ends) - 1)]:
            done.result()

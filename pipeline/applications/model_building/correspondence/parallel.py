"""Runs the same work on many scans in several processes. Threads gain nothing, as SuperLU and numpy hold the
interpreter."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TypeVar

from rig.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

FEW = 12  # with fewer items the processes' start (two seconds) costs more than they save
_BLAS_THREADS = "OPENBLAS_NUM_THREADS"
_CHUNK = 4  # items per message: the task's constant data (a prior of 40 MB) is sent once for each chunk


@dataclass(frozen=True, slots=True, eq=False)
class Workers:
    """Runs a module-level function, or a partial of one, over items in several processes."""

    pool: ProcessPoolExecutor | None

    def over(
        self, work: Callable[[Item], Result], items: Sequence[Item], stage: str, report: Progress | None
    ) -> list[Result]:
        """Runs ``work`` on the items and returns the results in their order. Raises the exception of the first item
        that fails."""
        results = map(work, items) if self.pool is None else self.pool.map(work, items, chunksize=_CHUNK)
        out = []
        for result in results:
            out.append(result)
            if report:
                report(stage, len(out) / len(items))
        return out


@contextmanager
def workers(count: int, items: int) -> Iterator[Workers]:
    """Yields ``count`` processes for ``items`` pieces of work; for few items the work runs in this process."""
    if count < 2 or items < FEW:
        yield Workers(None)
        return
    # fresh interpreters: a fork would copy locks that threads (BLAS, numba) of this process hold
    with _single_threaded_children(), ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        yield Workers(pool)


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Makes processes that are started in the block use one thread for linear algebra, as there is one process for each
    core."""
    before = os.environ.get(_BLAS_THREADS)
    os.environ[_BLAS_THREADS] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_BLAS_THREADS]
        else:
            os.environ[_BLAS_THREADS] = before

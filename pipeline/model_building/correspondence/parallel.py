"""The same work on many scans, in several processes (threads gain nothing: SuperLU and numpy hold the interpreter)."""

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
_CHUNK = 4  # what a task carries besides its item (a prior of 40 MB) travels once a chunk


@dataclass(frozen=True, slots=True, eq=False)
class Workers:
    """Runs work in processes: ``over`` runs a module-level function (or a partial of one) over items, in order; results
    come as a list."""

    pool: ProcessPoolExecutor | None

    def over(
        self, work: Callable[[Item], Result], items: Sequence[Item], stage: str, report: Progress | None
    ) -> list[Result]:
        """Runs ``work`` over the items, in order; an exception of it is raised here, the earliest item's first."""
        results = map(work, items) if self.pool is None else self.pool.map(work, items, chunksize=_CHUNK)
        out = []
        for result in results:
            out.append(result)
            if report:
                report(stage, len(out) / len(items))
        return out


@contextmanager
def workers(count: int, items: int) -> Iterator[Workers]:
    """Yields ``count`` processes for ``items`` pieces of work, or none where one process does as well."""
    if count < 2 or items < FEW:
        yield Workers(None)
        return
    # fresh interpreters: a fork would copy the locks of whatever threads (BLAS, numba) are at work here
    with _single_threaded_children(), ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        yield Workers(pool)


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Processes started in here do their linear algebra in one thread: there is one of them for each core."""
    before = os.environ.get(_BLAS_THREADS)
    os.environ[_BLAS_THREADS] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_BLAS_THREADS]
        else:
            os.environ[_BLAS_THREADS] = before

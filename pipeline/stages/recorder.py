"""Runs stages, collects their warnings and seconds, and reports their progress."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from pipeline.compute.threads import thread_count
from pipeline.compute.trace import span
from pipeline.stages.context import ReconstructionContext
from pipeline.warnings import ReportWarning
from rig.errors import Cancelled

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class Staged(Generic[T]):
    """Holds the product of a stage and its warnings."""

    product: T
    warnings: Sequence[ReportWarning] = ()


class Pending(Generic[T]):
    """Holds the product of a stage that runs in another thread. ``product`` may be read after the end of the
    ``Recorder.beside`` block."""

    product: T


class RunningStage:
    """Holds the context and the warnings of a running stage."""

    def __init__(self, context: ReconstructionContext, warnings: list[ReportWarning]) -> None:
        self.context = context
        self._warnings = warnings

    def keep(self, staged: Staged[T]) -> T:
        """Records the warnings of a ``Staged`` value, and returns its product."""
        self._warnings += staged.warnings
        return staged.product


class Recorder:
    """Runs stages in sequence, or one in parallel with others, and records their seconds and warnings.

    The context's ``progress`` is called when a stage begins, and by the stage as it advances; if it raises Cancelled,
    the stage ends. A parallel stage reports no progress. Only the time spent waiting for a parallel stage counts, so
    that all seconds add up to the job's duration. The seconds of stages with the same name are added.
    """

    def __init__(self, context: ReconstructionContext) -> None:
        self._context = context
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._warnings: list[ReportWarning] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[RunningStage]:
        """Reports the beginning of a stage, and measures the seconds of the ``with`` block."""
        self._context.progress(name, 0.0)
        with self._count_seconds(name), span("stage", name):
            yield RunningStage(self._context.within_stage(name), self._warnings)

    @contextmanager
    def beside(self, name: str, run: Callable[[ReconstructionContext], Staged[T]]) -> Iterator[Pending[T]]:
        """Runs a stage in another thread during the ``with`` block, and waits for it at the end of the block. If only
        one thread is allowed, the stage runs before the block.

        The stage may not use resources of the calling thread, such as the renderer. If the block fails, the stage is
        stopped when it next reports progress. Exceptions of the stage are raised at the end.
        """
        pending, abandoned = Pending[T](), threading.Event()

        def stop_if_abandoned(_: str, __: float) -> None:
            if abandoned.is_set():
                raise Cancelled

        def run_quietly() -> Staged[T]:
            with span("background", name), span("stage", name):
                return run(replace(self._context, progress=stop_if_abandoned))

        if thread_count() == 1:
            with self._count_seconds(name):
                pending.product = self._keep(run_quietly())
            with span("foreground", name):
                yield pending
            return
        with ThreadPoolExecutor(1, thread_name_prefix=name) as pool:
            future: Future[Staged[T]] = pool.submit(run_quietly)
            try:
                with span("foreground", name):
                    yield pending
            except BaseException:
                abandoned.set()
                raise
            with self._count_seconds(name):
                pending.product = self._keep(future.result())

    def _keep(self, staged: Staged[T]) -> T:
        return RunningStage(self._context, self._warnings).keep(staged)

    @contextmanager
    def _count_seconds(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - began

    @property
    def warnings(self) -> tuple[ReportWarning, ...]:
        """Returns the warnings of all finished stages, in the order in which they ended."""
        return tuple(self._warnings)

    def seconds(self) -> dict[str, float]:
        """Returns the seconds of every stage, and the ``total`` since the recorder was created."""
        return self._seconds | {"total": time.perf_counter() - self._started}

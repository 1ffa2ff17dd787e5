"""Runs stages: the one place that collects their warnings and seconds and reports progress."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Concatenate, Generic, ParamSpec, TypeVar

from pipeline.compute.threads import background_thread, thread_count
from pipeline.compute.trace import span
from pipeline.stages.context import ReconstructionContext
from pipeline.warnings import ReportWarning
from rig.errors import Cancelled
from rig.progress import Progress

T = TypeVar("T")
P = ParamSpec("P")


@dataclass(frozen=True, slots=True, eq=False)
class Staged(Generic[T]):
    """Holds the product of a stage and its warnings."""

    product: T
    warnings: Sequence[ReportWarning] = ()


StageFunction = Callable[Concatenate[ReconstructionContext, P], Staged[T]]


@dataclass(frozen=True, slots=True)
class Stage(Generic[P, T]):
    """Holds a stage's function, and the name under which progress and seconds are reported."""

    name: str
    function: StageFunction[P, T]

    def __call__(self, context: ReconstructionContext, /, *products: P.args, **options: P.kwargs) -> Staged[T]:
        """Runs the stage on the products of earlier stages."""
        return self.function(context, *products, **options)


def stage(name: str) -> Callable[[StageFunction[P, T]], Stage[P, T]]:
    """Decorates a function as a stage of the given name. The seconds of stages with the same name are added up."""

    def named(function: StageFunction[P, T]) -> Stage[P, T]:
        return Stage(name, function)

    return named


class Pending(Generic[T]):
    """Holds the product of a stage that runs in another thread. ``product`` may be read once the block of
    ``Recorder.beside`` has ended."""

    product: T


class Recorder:
    """Runs stages one after the other, or one beside others, and records their seconds and warnings.

    ``progress`` is called when a stage begins, and by the stage as it advances; a stage ends with Cancelled if it
    raises that. A stage that runs beside others reports no progress, and only the time that was spent waiting for it is
    counted: so all seconds add up to the job's.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._warnings: list[ReportWarning] = []

    def __call__(self, stage: Stage[P, T], context: ReconstructionContext, *products: P.args, **options: P.kwargs) -> T:
        """Runs a stage, records its seconds and warnings, and returns its product."""
        self._progress(stage.name, 0.0)
        began = time.perf_counter()
        staged = _run(stage, context.within_stage(stage.name), *products, **options)
        return self._record(stage.name, began, staged)

    @contextmanager
    def beside(
        self, stage: Stage[P, T], context: ReconstructionContext, *products: P.args, **options: P.kwargs
    ) -> Iterator[Pending[T]]:
        """Runs a stage in a thread of its own while the block runs others, and waits for it at the end of the block.
        With a single thread allowed, the stage runs before the block.

        The stage may use nothing that belongs to the calling thread, such as the renderer. If the block fails, the
        stage is stopped when it next reports progress. Raises what the stage raises.
        """
        pending, abandoned = Pending[T](), threading.Event()

        def go_on(_: str, __: float) -> None:
            if abandoned.is_set():
                raise Cancelled

        quiet = replace(context, progress=go_on)
        if thread_count() == 1:
            began = time.perf_counter()
            pending.product = self._record(stage.name, began, _run_behind(stage, quiet, *products, **options))
            with span("foreground", stage.name):
                yield pending
            return
        with background_thread(stage.name) as pool:
            future: Future[Staged[T]] = pool.submit(_run_behind, stage, quiet, *products, **options)
            try:
                with span("foreground", stage.name):
                    yield pending
            except BaseException:
                abandoned.set()
                raise
            began = time.perf_counter()
            pending.product = self._record(stage.name, began, future.result())

    def _record(self, name: str, began: float, staged: Staged[T]) -> T:
        self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - began
        self._warnings += staged.warnings
        return staged.product

    @property
    def warnings(self) -> tuple[ReportWarning, ...]:
        """Returns the warnings of all stages so far, in the order in which they ended."""
        return tuple(self._warnings)

    def seconds(self) -> dict[str, float]:
        """Returns the seconds of every stage, and ``total`` since the recorder was made."""
        return self._seconds | {"total": time.perf_counter() - self._started}


def _run(stage: Stage[P, T], context: ReconstructionContext, /, *products: P.args, **options: P.kwargs) -> Staged[T]:
    with span("stage", stage.name):
        return stage(context, *products, **options)


def _run_behind(
    stage: Stage[P, T], context: ReconstructionContext, /, *products: P.args, **options: P.kwargs
) -> Staged[T]:
    with span("background", stage.name):
        return _run(stage, context, *products, **options)

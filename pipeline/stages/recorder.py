"""How stages are run: the one place that collects warnings and seconds and tells progress."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Concatenate, Generic, ParamSpec, TypeVar

from pipeline.compute.trace import span
from pipeline.stages.context import ReconstructionContext
from pipeline.warnings import ReportWarning
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
        return self.function(context, *products, **options)


def stage(name: str) -> Callable[[StageFunction[P, T]], Stage[P, T]]:
    """Makes the decorated function a stage with the given name. The seconds of stages with the same name add up."""

    def named(function: StageFunction[P, T]) -> Stage[P, T]:
        return Stage(name, function)

    return named


class Recorder:
    """Runs stages one after the other and records their seconds and warnings.

    ``progress`` is called when a stage begins, and by the stage as it advances; if it raises Cancelled, the stage does
    too.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._warnings: list[ReportWarning] = []

    def __call__(self, stage: Stage[P, T], context: ReconstructionContext, *products: P.args, **options: P.kwargs) -> T:
        self._progress(stage.name, 0.0)
        began = time.perf_counter()
        with span("stage", stage.name):
            staged = stage(context.within_stage(stage.name), *products, **options)
        self._seconds[stage.name] = self._seconds.get(stage.name, 0.0) + time.perf_counter() - began
        self._warnings += staged.warnings
        return staged.product

    @property
    def warnings(self) -> tuple[ReportWarning, ...]:
        return tuple(self._warnings)

    def seconds(self) -> dict[str, float]:
        """Returns the seconds of every stage, and ``total`` since the recorder was made."""
        return self._seconds | {"total": time.perf_counter() - self._started}

"""Shows the progress of a batch: a bar on a terminal, otherwise one line for each capture, for a scheduler's log."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from server.batch.run import Outcome
from server.cli.answers import QUIET

if TYPE_CHECKING:
    from server.batch.plan import BatchTask


Clock = Callable[[], float]


class BatchProgress:
    """Counts finished captures, of which ``workers`` run at once. Estimates the remaining time from their mean
    duration, and from ``expected_s`` until the first is done. ``clock`` returns seconds and never goes back."""

    def __init__(self, captures: int, workers: int, expected_s: float, clock: Clock = time.monotonic) -> None:
        self._captures, self._workers, self._expected_s, self._clock = captures, workers, expected_s, clock
        self._running: dict[str, tuple[float, float]] = {}  # by name: start time, share done
        self._took: list[float] = []
        self.ended = self.failed = 0

    def start(self, name: str) -> None:
        """Records that work on a capture begins."""
        self._running[name] = self._clock(), 0.0

    def report(self, name: str, share: float) -> None:
        """Records which share of a capture is done, from 0 to 1."""
        if name in self._running:
            self._running[name] = self._running[name][0], min(1.0, max(0.0, share))

    def end(self, name: str, *, failed: bool) -> None:
        """Records that a capture has ended. The duration of one that failed does not count for the estimate."""
        since, _ = self._running.pop(name, (self._clock(), 0.0))
        self.ended += 1
        self.failed += failed
        if not failed:
            self._took.append(self._clock() - since)

    def share(self) -> float:
        """Returns the share of the whole batch that is done, from 0 to 1."""
        begun = sum(share for _, share in self._running.values())
        return min(1.0, (self.ended + begun) / max(1, self._captures))

    def remaining_s(self) -> float:
        """Estimates the remaining seconds, as if all workers stayed at work."""
        mean_s = sum(self._took) / len(self._took) if self._took else self._expected_s
        waiting = max(0, self._captures - self.ended - len(self._running))
        begun = [mean_s * (1.0 - share) for _, share in self._running.values()]
        at_once = max(1, min(self._workers, waiting + len(begun)))
        return max([(mean_s * waiting + sum(begun)) / at_once, *begun])


def told_time(seconds: float) -> str:
    """Formats a duration in seconds, minutes or hours, as coarsely as an estimate deserves."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class BatchDisplay:
    """Shows the events of a batch run, as its ``Observer``. ``bar`` is rich's progress bar, or None if standard error
    is no terminal."""

    def __init__(self, workers: int, expected_s: float, bar: Any = None) -> None:
        self._workers, self._expected_s, self._bar = workers, expected_s, bar
        self._progress = BatchProgress(0, workers, expected_s)
        self._task = None if bar is None else bar.add_task("reading", total=1.0, left="")
        self._count, self._began = 0, time.monotonic()

    @classmethod
    @contextmanager
    def opened(cls, workers: int, tasks: "Sequence[BatchTask]") -> "Iterator[BatchDisplay]":
        """Yields a display that is closed at the end of the block."""
        expected_s = max((sum(task.expected_s.values()) for task in tasks), default=0.0)
        if QUIET.is_set() or not sys.stderr.isatty():
            yield cls(workers, expected_s)
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        description, left = TextColumn("{task.description}"), TextColumn("{task.fields[left]}")
        columns = (description, BarColumn(), TimeElapsedColumn(), left)
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            yield cls(workers, expected_s, bar)

    def prepare(self, tasks: "Sequence[BatchTask]") -> None:
        """Compiles the numerical loops that the batch needs and that are not compiled on this machine yet, so that not
        every worker compiles them for itself."""
        from pipeline.settings import settings_from_document
        from server.tasks.prepare import prepare_kernels

        kinds = {task.settings_sha256: task.settings for task in tasks}
        for settings in kinds.values():
            prepare_kernels(self._prepared, settings_from_document(settings))

    def begin(self, pending: int) -> None:
        """Begins to show progress of ``pending`` captures."""
        self._count, self._progress = pending, BatchProgress(pending, self._workers, self._expected_s)
        self._show()

    def start(self, name: str) -> None:
        """Notes that work on a capture begins."""
        self._progress.start(name)

    def report(self, name: str, share: float) -> None:
        """Shows that ``share`` (0 to 1) of a capture is done."""
        self._progress.report(name, share)
        self._show()

    def end(self, outcome: Outcome) -> None:
        """Shows how a capture ended, and why if it failed."""
        self._progress.end(outcome.name, failed=outcome.state == "failed")
        self._show()
        if outcome.failure is not None:
            self._say(f"eigenhead: {outcome.name}: {outcome.failure.message}")
        elif self._bar is None and outcome.state == "made" and not QUIET.is_set():
            ended, left = self._progress.ended, told_time(self._progress.remaining_s())
            self._say(f"{ended} of {self._count}: {outcome.name} in {outcome.seconds:.0f} s, about {left} left")

    def seconds(self) -> float:
        """Returns the seconds since the display was made."""
        return time.monotonic() - self._began

    def _prepared(self, stage: str, share: float) -> None:
        if self._bar is not None:
            self._bar.update(self._task, description=stage, completed=share)

    def _show(self) -> None:
        if self._bar is None:
            return
        progress = self._progress
        failed = f", {progress.failed} failed" if progress.failed else ""
        description = f"{progress.ended} of {self._count}{failed}"
        left = f"about {told_time(progress.remaining_s())} left"
        self._bar.update(self._task, description=description, completed=progress.share(), left=left)

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.console.print(line, markup=False, highlight=False)
        else:
            print(line, file=sys.stderr, flush=True)

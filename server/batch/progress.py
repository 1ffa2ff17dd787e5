"""Computes how much of a batch is done, and estimates its remaining time."""

import time
from collections.abc import Callable

Clock = Callable[[], float]


class BatchProgress:
    """Counts the captures that are done and estimates the remaining time from their mean duration.

    Args:
        captures: how many are to be made.
        workers: how many are made at once.
        expected_s: seconds of one capture, used before the first is done.
        clock: returns seconds and never goes back.
    """

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

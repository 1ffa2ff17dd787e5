"""Seconds by stage, told as each begins."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

Report = Callable[[str, float], None]


@dataclass
class Clock:
    """Seconds by stage, and the one place that reports it."""

    report: Report
    seconds: dict[str, float] = field(default_factory=dict)
    _stage: str = ""
    _since: float = field(default_factory=time.perf_counter)

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        if stage:
            self.report(stage, 0.0)


def of_stage(report: Report, stage: str, _: str, fraction: float) -> None:
    """Tells the progress of something within a stage as that stage's."""
    report(stage, fraction)

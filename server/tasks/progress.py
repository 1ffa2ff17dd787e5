"""From the stages of a reconstruction to one progress and one remaining time.

The pipeline reports (stage, fraction of that stage). How long each stage takes is learnt from the jobs that went
before, by method; the first job goes by the shares measured on two cores.
"""

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from server.storage.events import EventLog

FIRST_S = {
    method: {"read": 0.4, "segmentation": 1.2, "alignment": 0.6, "fit": fit, "texture": 1.0, "depth": 4.0, "bust": 3.0}
    | {"evidence": 0.5}
    for method, fit in (("contour", 0.8), ("simplex", 60.0))
}
WRITE_S = 1.5
EVERY_S = 0.25  # the shortest time between two progress events of one stage
LEARNING = 0.3  # weight of the newest job


class StageDurations:
    """Seconds that each stage is expected to take, by method."""

    def __init__(self) -> None:
        self._seconds = {method: stages | {"write": WRITE_S} for method, stages in FIRST_S.items()}

    def of(self, method: str) -> dict[str, float]:
        return self._seconds.setdefault(method, dict(self._seconds["contour"]))

    def learn(self, method: str, seconds: dict[str, float]) -> None:
        known = self.of(method)
        for stage, took in seconds.items():
            known[stage] = (1 - LEARNING) * known.get(stage, took) + LEARNING * took


class JobProgress:
    """One job on its way: feed it reports, ask for progress and remaining seconds."""

    def __init__(self, expected: dict[str, float]) -> None:
        self._expected = dict(expected)
        self.seconds: dict[str, float] = {}
        self._began = self._since = time.monotonic()
        self._stage, self._fraction, self._progress = "", 0.0, 0.0

    def report(self, stage: str, fraction: float) -> None:
        now = time.monotonic()
        if stage != self._stage:
            self._close(now)
            self._stage, self._since = stage, now
        self._fraction = min(1.0, max(0.0, fraction))

    def finish(self) -> dict[str, float]:
        """Seconds of every stage."""
        self._close(time.monotonic())
        return self.seconds

    def remaining_s(self) -> float:
        now = time.monotonic()
        later = sum(s for stage, s in self._expected.items() if stage not in self.seconds and stage != self._stage)
        spent, usual = now - self._since, self._expected.get(self._stage, 0.0)
        if self._fraction > 0.05:
            return spent * (1 - self._fraction) / self._fraction + later
        return max(0.0, usual - spent) + later

    def progress(self) -> float:
        """0 to 1, never falling."""
        elapsed = time.monotonic() - self._began
        share = elapsed / max(elapsed + self.remaining_s(), 1e-9)
        self._progress = max(self._progress, min(0.99, share))
        return self._progress

    def _close(self, now: float) -> None:
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since


class ProgressMeter:
    """Turns the reports of a job into events: at most one in ``EVERY_S`` within a stage, with the remaining time."""

    def __init__(self, log: "EventLog", job_id: str, progress: JobProgress) -> None:
        self._log, self._job_id, self._progress = log, job_id, progress
        self._last = ("", 0.0)

    def report(self, stage: str, fraction: float) -> None:
        self._progress.report(stage, fraction)
        now = time.monotonic()
        if stage == self._last[0] and now - self._last[1] < EVERY_S:
            return
        self._last = (stage, now)
        share, left_s = round(self._progress.progress(), 4), round(self._progress.remaining_s(), 1)
        self._log.append(self._job_id, {"state": "running", "stage": stage, "progress": share, "eta_s": left_s})

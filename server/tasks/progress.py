"""Computes a job's progress and remaining time from the progress of its stages.

The pipeline reports a stage and a fraction of it; some stages report no fraction. A stage that continues after another
interrupted it counts as a stage of its own: "fit" interrupted by "parts" continues as "fit again". The expected seconds
of each stage come from ``server.tasks.stage_durations``.
"""

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from server.storage.events import EventLog
    from server.storage.records import EventDocument

AGAIN = " again"
EVERY_S = 0.25  # the shortest time between two progress events of one stage, unless nobody looks so often
OVERTIME = 0.1  # of a stage's expected time: what is left of one that has taken longer
PACE_S = 4.0  # of work, before a machine's pace counts as much as the expectation
FRACTION_LEAST = 0.05  # below it a stage's own fraction says little of its end

Clock = Callable[[], float]

log = structlog.get_logger()


class JobProgress:
    """Computes progress and remaining time of one job from the reports of its stages. ``expected``: seconds of each
    stage, in their order; ``clock`` returns seconds and never goes back."""

    def __init__(self, expected: Mapping[str, float], clock: Clock = time.monotonic) -> None:
        self._expected, self._clock = dict(expected), clock
        self.seconds: dict[str, float] = {}
        self.stage = ""
        self._visit, self._since = "", clock()
        self._fraction, self._progress = 0.0, 0.0

    def report(self, stage: str, fraction: float) -> None:
        """Records that a stage is running and which fraction of it is done, 0 to 1."""
        if stage != self.stage:
            self._close()
            self.stage, self._since = stage, self._clock()
            self._visit = stage + AGAIN if stage in self.seconds else stage
            self._leave_out_before(self._visit)
            self._expected.setdefault(self._visit, 0.0)
        self._fraction = min(1.0, max(0.0, fraction))

    def counts(self) -> "EventDocument":
        """Returns what an event states besides stage, progress and remaining time."""
        return {}

    def finish(self) -> dict[str, float]:
        """Ends the last stage and returns the seconds that each stage took."""
        self._close()
        self.stage = self._visit = ""
        return self.seconds

    def remaining_s(self) -> float:
        """Estimates the seconds until the job ends. The expected times are scaled by the pace of the stages that are
        done."""
        return (self._rest_of_stage() + self._to_come()) * self._pace()

    def progress(self) -> float:
        """Returns the fraction of the job that is done, 0 to 0.99. It never decreases. Each stage counts by its
        expected time."""
        done = sum(took for stage, took in self._expected.items() if stage in self.seconds and stage != self._visit)
        expected_s, spent = self._expected.get(self._visit, 0.0), self._spent_s() / self._pace()
        now = done + expected_s * spent / max(spent + self._rest_of_stage(), 1e-9)
        self._progress = max(self._progress, min(0.99, now / max(done + expected_s + self._to_come(), 1e-9)))
        return self._progress

    def _rest_of_stage(self) -> float:
        """Returns the expected remaining seconds of the stage: by usual duration or by fraction, the larger one."""
        spent, usual = self._spent_s() / self._pace(), self._expected.get(self._visit, 0.0)
        rest = max(usual - spent, OVERTIME * usual)
        if FRACTION_LEAST < self._fraction < 1:
            rest = max(rest, spent * (1 - self._fraction) / self._fraction)
        return rest

    def _to_come(self) -> float:
        """Returns the expected seconds of the stages that have not begun."""
        return sum(took for stage, took in self._expected.items() if stage not in self.seconds and stage != self._visit)

    def _pace(self) -> float:
        """Returns measured over expected seconds of the stages that are done."""
        done = [stage for stage in self.seconds if stage != self._visit]
        took = sum(self.seconds[stage] for stage in done)
        return (took + PACE_S) / (sum(self._expected.get(stage, 0.0) for stage in done) + PACE_S)

    def _spent_s(self) -> float:
        return self.seconds.get(self._visit, 0.0) + self._clock() - self._since

    def _leave_out_before(self, visit: str) -> None:
        """Removes stages that this job has skipped from the expected ones."""
        order = list(self._expected)
        if visit in order:
            for earlier in order[: order.index(visit)]:
                if earlier not in self.seconds:
                    del self._expected[earlier]

    def _close(self) -> None:
        if self.stage:
            self.seconds[self._visit] = self._spent_s()


class ProgressMeter:
    """Writes the progress and remaining time of a job to its events: when a stage begins, and then at most every
    ``every_s`` seconds. The event of a stage's beginning stays; any other event replaces the previous one, so a long
    job has as few events as a short one."""

    def __init__(self, log: "EventLog", job_id: str, progress: JobProgress, every_s: float = EVERY_S) -> None:
        self._log, self._job_id, self._progress, self._every_s = log, job_id, progress, every_s
        self._last = ("", 0.0)
        self._superseded: int | None = None

    def report(self, stage: str, fraction: float) -> None:
        """Records the progress of a stage (fraction 0 to 1), and writes an event if one is due."""
        self._progress.report(stage, fraction)
        self.tick()

    def tick(self) -> None:
        """Writes an event if one is due. Call ``tick`` often during stages that report no progress themselves."""
        stage, now = self._progress.stage, time.monotonic()
        if not stage or (stage == self._last[0] and now - self._last[1] < self._every_s):
            return
        begins = stage != self._last[0]
        if begins:
            log.info("stage", stage=stage)
        self._last = (stage, now)
        share, left_s = round(self._progress.progress(), 4), round(self._progress.remaining_s(), 1)
        event: EventDocument = {"state": "running", "stage": stage, "progress": share, "eta_s": left_s}
        event |= self._progress.counts()
        seq = self._log.append(self._job_id, event, self._superseded)
        self._superseded = None if begins else seq

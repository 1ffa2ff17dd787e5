"""Progress and remaining time of a job whose stages report little."""

from itertools import pairwise

from server.storage.records import EventDocument
from server.tasks.progress import JobProgress, ProgressMeter

EXPECTED = {"read": 1.0, "fit": 1.0, "parts": 1.0, "fit again": 3.0, "depth": 4.0, "write": 2.0}
VISITS = [("read", 1.0), ("fit", 1.0), ("parts", 1.0), ("fit", 3.0), ("depth", 4.0), ("write", 2.0)]
TICK_S = 0.25


class Watch:
    """A clock that tests turn by hand."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def run(expected: dict[str, float], visits: list[tuple[str, float]], slower: float = 1.0) -> list[tuple[float, float]]:
    """(progress, error of the remaining time in seconds) at every tick of a job without fractions."""
    watch = Watch()
    progress, seen = JobProgress(expected, watch), []
    end = sum(took * slower for _, took in visits)
    for stage, took in visits:
        progress.report(stage, 0.0)
        until = watch.now + took * slower
        while watch.now < until - 1e-9:
            seen.append((progress.progress(), progress.remaining_s() - (end - watch.now)))
            watch.now += TICK_S
    assert progress.finish().keys() >= dict(visits).keys()
    return seen


def steps(seen: list[tuple[float, float]]) -> list[float]:
    return [later - earlier for (earlier, _), (later, _) in pairwise(seen)]


def test_a_job_that_goes_as_expected_moves_evenly_and_knows_its_end() -> None:
    seen = run(EXPECTED, VISITS)
    assert seen[0][0] == 0.0
    assert max(steps(seen)) < 2 * TICK_S / sum(EXPECTED.values())
    assert min(steps(seen)) >= 0.0
    # A stage that is about to end is given a tenth of its time, 0.4 s of "depth".
    assert max(abs(error) for _, error in seen) < 0.5


def test_a_slow_machine_is_noticed_after_the_first_stages() -> None:
    seen = run(EXPECTED, VISITS, slower=4.0)
    assert max(steps(seen)) < 0.05
    late = [error for share, error in seen if share > 0.5]
    assert max(abs(error) for error in late) < 0.4 * 48.0


def test_stages_that_do_not_come_or_were_not_known_make_no_leap() -> None:
    assert max(steps(run(EXPECTED, [*VISITS[:2], *VISITS[4:]]))) < 0.15  # 2 s of 12 become 2 s of 8, and a tick
    assert max(steps(run(EXPECTED, [*VISITS[:5], ("polish", 3.0), VISITS[5]]))) < 0.15


def test_the_fraction_of_a_stage_counts_where_it_takes_longer() -> None:
    watch = Watch()
    progress = JobProgress({"fit": 1.0}, watch)
    progress.report("fit", 0.0)
    watch.now = 10.0
    progress.report("fit", 0.5)
    assert progress.remaining_s() == 10.0
    assert progress.progress() == 0.5


class Recorded:
    """Stands for the event log: keeps what is appended."""

    def __init__(self) -> None:
        self.documents: list[EventDocument] = []

    def append(self, job_id: str, document: EventDocument, instead_of: int | None = None) -> int:
        self.documents.append(document)
        return len(self.documents)


def test_a_silent_stage_is_told_of_when_asked(monkeypatch) -> None:
    watch, log = Watch(), Recorded()
    monkeypatch.setattr("server.tasks.progress.time.monotonic", watch)
    meter = ProgressMeter(log, "job", JobProgress({"depth": 4.0}, watch))  # type: ignore[arg-type]
    meter.tick()
    assert log.documents == []
    meter.report("depth", 0.0)
    for _ in range(100):
        watch.now += 0.05
        meter.tick()
    shares = [document.get("progress", -1.0) for document in log.documents]
    assert 18 <= len(shares) <= 21
    assert shares == sorted(shares)
    assert max(later - earlier for earlier, later in pairwise(shares)) < 0.1

"""What is left of a batch, by a clock that the test moves."""

import pytest

from server.batch.progress import BatchProgress, told_time


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_first_guess_then_the_mean_of_those_that_were_made() -> None:
    clock = Clock()
    progress = BatchProgress(6, 2, 30.0, clock)
    assert (progress.share(), progress.remaining_s()) == (0.0, 90.0)  # six of 30 s, two at once
    progress.start("a")
    progress.start("b")
    progress.report("a", 0.5)
    progress.report("b", 0.5)
    assert progress.share() == pytest.approx(1 / 6)
    assert progress.remaining_s() == pytest.approx((4 * 30 + 2 * 15) / 2)
    clock.now = 20.0
    progress.end("a", failed=False)
    assert progress.remaining_s() == pytest.approx((4 * 20 + 10) / 2)
    progress.end("b", failed=True)  # after 20 s, which says nothing
    assert (progress.ended, progress.failed) == (2, 1)
    assert progress.remaining_s() == pytest.approx(40.0)


def test_the_last_capture_has_one_worker_however_many_there_are() -> None:
    progress = BatchProgress(1, 8, 30.0, Clock())
    progress.start("a")
    progress.report("a", 0.9)
    assert progress.remaining_s() == pytest.approx(3.0)
    progress.end("a", failed=False)
    assert (progress.share(), progress.remaining_s()) == (1.0, 0.0)


@pytest.mark.parametrize(("seconds", "words"), [(0, "0 s"), (89, "89 s"), (840, "14 min"), (9000, "2.5 h")])
def test_times_in_words(seconds: float, words: str) -> None:
    assert told_time(seconds) == words

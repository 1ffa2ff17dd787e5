"""What people see of a batch: a line a capture in a log, a bar with the remaining time on a terminal."""

import io
import sys

import pytest

from rig.messages.message import compose
from server.batch.folder import FailureRecord
from server.batch.run import Outcome
from server.cli.batch import BatchDisplay, BatchProgress, format_time

FAILURE = FailureRecord("input", compose("batch-list-empty"), (), None)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def go_through(display: BatchDisplay) -> None:
    display.begin(3)
    for name in ("anna", "bert", "carl"):
        display.report(name, 0.5)
    display.end(Outcome("anna", "made", 21.4))
    display.end(Outcome("bert", "failed", 1.0, FAILURE))
    display.end(Outcome("carl", "kept"))


def test_a_log_has_a_line_a_capture_with_the_time_that_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    with BatchDisplay.opened(2, ()) as display:
        go_through(display)
        assert display.seconds() >= 0
    first, second = capsys.readouterr().err.splitlines()
    assert first == "1 of 3: anna in 21 s, about 0 s left"
    assert second == "eigenhead: bert: the list names no capture"


def test_a_terminal_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with BatchDisplay.opened(2, ()) as display:
        go_through(display)
        shown = display._bar.get_renderable()
    rows = [column._cells for column in shown.renderables[0].columns] if hasattr(shown, "renderables") else []
    assert "3 of 3, 1 failed" in str(rows)
    assert "about 0 s left" in str(rows)
    assert "bert: the list names no capture" in sys.stderr.getvalue()  # type: ignore[attr-defined]


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_first_guess_then_the_mean_of_those_that_were_made() -> None:
    clock = Clock()
    progress = BatchProgress(6, 2, 30.0, clock)
    assert (progress.share(), progress.remaining_s()) == (0.0, 90.0)  # six of 30 s, two at once
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
    progress.report("a", 0.9)
    assert progress.remaining_s() == pytest.approx(3.0)
    progress.end("a", failed=False)
    assert (progress.share(), progress.remaining_s()) == (1.0, 0.0)


@pytest.mark.parametrize(("seconds", "words"), [(0, "0 s"), (89, "89 s"), (840, "14 min"), (9000, "2.5 h")])
def test_times_in_words(seconds: float, words: str) -> None:
    assert format_time(seconds) == words

"""What people see of a batch: a line a capture in a log, a bar with the remaining time on a terminal."""

import io
import sys

import pytest

from rig.messages.message import compose
from server.batch.folder import FailureRecord
from server.batch.run import Outcome
from server.cli.batch_display import BatchDisplay

FAILURE = FailureRecord("input", compose("batch-list-empty"), (), None)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def go_through(display: BatchDisplay) -> None:
    display.begin(3)
    for name in ("anna", "bert", "carl"):
        display.start(name)
        display.report(name, 0.5)
    display.end(Outcome("anna", "made", 21.4))
    display.end(Outcome("bert", "failed", 1.0, FAILURE))
    display.start("carl")
    display.end(Outcome("carl", "kept"))


def test_a_log_has_a_line_a_capture_with_the_time_that_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    with BatchDisplay.opened(2, ()) as display:
        go_through(display)
        assert display.seconds() >= 0
    first, second = capsys.readouterr().err.splitlines()
    assert first == "1 of 3: anna in 21 s, about 0 s left"
    assert second == "eigenhead: bert: names no capture"


def test_a_terminal_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with BatchDisplay.opened(2, ()) as display:
        go_through(display)
        shown = display._bar.get_renderable()
    rows = [column._cells for column in shown.renderables[0].columns] if hasattr(shown, "renderables") else []
    assert "3 of 3, 1 failed" in str(rows)
    assert "about 0 s left" in str(rows)
    assert "bert: names no capture" in sys.stderr.getvalue()  # type: ignore[attr-defined]

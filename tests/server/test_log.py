"""Log lines: JSON throughout, and no traceback of a job that failed for a known reason."""

import io
import json
import logging
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
import structlog
from dbos import error as dbos_error

from rig.errors import InputError
from server.log import set_up


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    loggers = [logging.getLogger(), logging.getLogger("dbos")]
    before = [(logger, logger.handlers[:], logger.level, logger.propagate) for logger in loggers]
    yield
    for logger, handlers, level, propagate in before:
        logger.handlers[:], logger.propagate = handlers, propagate
        logger.setLevel(level)
    structlog.reset_defaults()


def test_lines_of_libraries_are_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    set_up(as_json=True)
    structlog.get_logger().info("ours", job="a")
    logging.getLogger("some.library").warning("theirs %d", 7)
    logging.getLogger("dbos").error("the engine's", exc_info=ZeroDivisionError("unforeseen"))
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [(line["event"], line["level"]) for line in lines] == [
        ("ours", "info"),
        ("theirs 7", "warning"),
        ("the engine's", "error"),
    ]
    assert lines[1]["logger"] == "some.library"
    assert "ZeroDivisionError" in lines[2]["exception"]


def test_a_known_failure_leaves_no_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    set_up(as_json=False)
    for error in (
        InputError("capture", ["cam00 sees nobody"]),
        dbos_error.DBOSWorkflowCancelledError("cancelled"),
        dbos_error.DBOSAwaitedWorkflowCancelledError("cancelled"),
        httpx.ConnectError("Connection refused"),
    ):
        logging.getLogger("dbos").error("Exception encountered in background workflow:", exc_info=error)
    assert capsys.readouterr().err == ""


def test_a_standard_error_that_was_replaced_gets_the_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", first)
    set_up(as_json=True)
    log = structlog.get_logger()
    log.info("before")
    monkeypatch.setattr(sys, "stderr", second)
    first.close()
    log.info("after")
    assert json.loads(second.getvalue())["event"] == "after"


def test_work_goes_on_where_no_line_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a service's does on a full disk: a request whose line could not be written ended its connection."""
    levels, said = ("info", "warning", "error", "critical", "exception"), []
    with suppress(OSError), Path("/dev/full").open("w") as full:  # the end tries the lines once more
        monkeypatch.setattr(sys, "stderr", full)
        set_up(as_json=True)
        for level in levels:
            getattr(structlog.get_logger(), level)("said in vain")
            said.append(level)
    assert tuple(said) == levels

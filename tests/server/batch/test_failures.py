"""Failures in words that fit a batch."""

import errno
from pathlib import Path

import pytest

from rig.errors import Cancelled, EigenheadError, InputError
from rig.messages.message import compose
from server.batch.folder import Origin
from server.batch.run import failure_of
from server.tasks.child import WorkFailed

ORIGIN = Origin("", "", "", "")


def crash(how: str, kind: str = "crash", **number: int) -> WorkFailed:
    return WorkFailed(kind, compose("work-crashed", how=compose(how, **number)))


@pytest.mark.parametrize(
    ("error", "origin", "kind", "words"),
    [
        (InputError("capture", [compose("settings-no-table")]), ORIGIN, "input", "is no table of settings"),
        (Cancelled(), ORIGIN, "refused", "cancelled"),
        (crash("ended-by-signal", "killed", number=9), ORIGIN, "crash", "fewer --workers"),
        (crash("ended-by-signal", number=11), ORIGIN, "crash", "signal 11"),
        (crash("ended-with-status", status=9), ORIGIN, "crash", "status 9"),
        (WorkFailed("out-of-memory", compose("out-of-memory")), ORIGIN, "out-of-memory", "fewer --workers"),
        (WorkFailed("disk-full", compose("disk-full")), ORIGIN, "disk-full", "make room and run the batch again"),
        (OSError(errno.ENOSPC, "No space left"), ORIGIN, "disk-full", "make room"),
        (OSError(errno.EACCES, "Permission denied", "/x"), ORIGIN, "unwritable", "/x cannot be written (Permission"),
        (OSError(errno.EACCES, "Permission denied"), None, "input", "shots/anna cannot be read (Permission denied)"),
    ],
)
def test_kind_and_words(error: EigenheadError | OSError, origin: Origin | None, kind: str, words: str) -> None:
    failure = failure_of(error, Path("shots/anna"), origin)
    assert (failure.kind, failure.origin) == (kind, origin)
    assert words in failure.message.text


def test_faults_and_traces_are_kept() -> None:
    fault = compose("settings-no-table")
    assert failure_of(InputError("x", [fault]), Path(), ORIGIN).faults == (fault,)
    assert failure_of(WorkFailed("bug", "boom", (), "line 3"), Path(), ORIGIN).trace == "line 3"

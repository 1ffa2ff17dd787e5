"""Failures in words that fit a batch."""

import errno
from pathlib import Path

import pytest

from rig.errors import Cancelled, EigenheadError
from rig.messages.message import compose
from server.batch.folder import Origin
from server.batch.run import failure_of
from server.tasks.child import WorkFailed

ORIGIN = Origin("", "", "", "")
STATUS = compose("ended-with-status", status=9)


@pytest.mark.parametrize(
    ("error", "origin", "kind", "words"),
    [
        (Cancelled(), ORIGIN, "refused", "cancelled"),
        (WorkFailed("crash", compose("work-crashed", how=STATUS)), ORIGIN, "crash", "status 9"),
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

"""Provides pauses of a worker's steps that end when the worker stops."""

import threading
from collections.abc import Callable
from typing import TypeVar

import structlog

from server.storage.database import AWAY

T = TypeVar("T")
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 5.0  # of the database: it answers all or none, and many wait for it

log = structlog.get_logger()


class WorkerStopped(BaseException):
    """Ends a step if its worker stops, or if the engine could not write to the database. The class is no Exception: the
    job engine would record an Exception as the failure of the job, which a worker is to continue."""


def pause(stop: threading.Event, seconds: float) -> None:
    """Waits for ``seconds``. Raises WorkerStopped as soon as ``stop`` is set."""
    if stop.wait(seconds):
        raise WorkerStopped


def insist(stop: threading.Event, action: Callable[[], T]) -> T:
    """Calls ``action`` repeatedly while the database does not answer; the action may then happen twice. Raises
    WorkerStopped, and other errors of ``action``."""
    pause_s = FIRST_PAUSE_S
    while True:
        try:
            return action()
        except AWAY as error:
            log.warning("a job waits for the database", reason=str(error)[:200])
        pause(stop, pause_s)
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

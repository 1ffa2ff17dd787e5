"""Pauses of a worker's steps, which its stop ends."""

import threading


class WorkerStopped(BaseException):
    """Ends a step whose worker stops. It is no Exception: the engine would record one as the failure of the job, which
    another worker is to go on with."""


def pause(stop: threading.Event, seconds: float) -> None:
    """Waits so many seconds. Raises WorkerStopped as soon as ``stop`` is set."""
    if stop.wait(seconds):
        raise WorkerStopped

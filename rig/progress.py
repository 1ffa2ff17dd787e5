"""Defines how long-running work reports its progress."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Takes a stage's name and how much of it is done, 0 to 1; long stages call it often. It may raise
``rig.errors.Cancelled``, which ends the work."""


def discard_progress(stage: str, fraction: float) -> None:
    """Ignores a progress report, for callers that do not show progress."""

"""The live view of the simulated studio, asked of a child process, so that this one need not load what draws it."""

from typing import NotRequired, TypedDict

from server.tasks.child import Bench, Report


class Frame(TypedDict):
    """A camera's picture (None: it shows nothing) and what was measured on it."""

    name: str
    jpeg: bytes | None
    mean: NotRequired[float]
    clipped: NotRequired[float]
    blur_px: NotRequired[float | None]
    fault: NotRequired[str]


def frames(bench: Bench, report: Report, *, look: int) -> list[Frame]:
    """One frame a camera; now and then one of them has blur_px."""
    from server.console import studio_drawing

    return studio_drawing.frames(bench, look)

"""Requests the live view of the simulated studio from a child process, so that the service need not import what draws
it."""

from rig.progress import Progress
from server.console.live_frame import LiveFrame
from server.tasks.child import WorkerContext


def frames(context: WorkerContext, report: Progress, *, look: int) -> list[LiveFrame]:
    """Returns the present picture of each camera of the simulated studio, drawn in a child process. ``look`` counts the
    calls."""
    from server.console import studio_drawing

    return studio_drawing.frames(context, look)

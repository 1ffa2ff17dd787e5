"""The live view of the simulated studio, asked of a child process, so that this one need not load what draws it."""

from rig.progress import Progress
from server.console.live_frame import LiveFrame
from server.tasks.child import WorkerContext


def frames(context: WorkerContext, report: Progress, *, look: int) -> list[LiveFrame]:
    """Returns one frame a camera; now and then one of them has blur_px."""
    from server.console import studio_drawing

    return studio_drawing.frames(context, look)

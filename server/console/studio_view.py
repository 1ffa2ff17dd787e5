"""The live view of the simulated studio, asked of a child process, so that this one need not load what draws it."""

from rig.progress import Progress
from server.console.live_frame import LiveFrame
from server.tasks.child import WorkerContext


def frames(context: WorkerContext, report: Progress, *, look: int) -> list[LiveFrame]:
    """Returns the present picture of each camera of the simulated studio. Now and then one camera's blur is measured,
    too."""
    from server.console import studio_drawing

    return studio_drawing.frames(context, look)

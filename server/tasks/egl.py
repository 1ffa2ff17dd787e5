"""Whether this machine draws; runs in a child process."""

from rig.progress import Progress
from server.tasks.child import WorkerContext


def try_egl(context: WorkerContext, report: Progress) -> str:
    """Opens a GL context and returns the name of its device. Raises the renderer's error where that fails."""
    from rig.render.context import GlContext  # without the renderer's NumPy: half the time

    gl = GlContext()
    try:
        return gl.description
    finally:
        gl.close()

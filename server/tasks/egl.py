"""Whether this machine draws; runs in a child process."""

from rig.progress import Progress
from server.tasks.child import WorkerContext


def try_egl(context: WorkerContext, report: Progress) -> str:
    """Returns the name of the GL device. Raises the renderer's own error."""
    from rig.render.context import GlContext  # without the renderer's NumPy: half the time

    gl = GlContext()
    try:
        return gl.description
    finally:
        gl.close()

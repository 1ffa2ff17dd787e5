"""Whether this machine draws; runs in a child process."""

from rig.progress import Progress
from server.tasks.child import Bench


def try_egl(bench: Bench, report: Progress) -> str:
    """The name of the GL device. Raises the renderer's own error."""
    from rig.render.context import GlContext  # without the renderer's NumPy: half the time

    context = GlContext()
    try:
        return context.description
    finally:
        context.close()

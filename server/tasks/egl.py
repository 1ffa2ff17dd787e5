"""Whether this machine draws; runs in a child process."""

from server.tasks.child import Bench, Report


def try_egl(bench: Bench, report: Report) -> str:
    """The name of the GL device. Raises the renderer's own error."""
    from rig.render.renderer import Renderer

    with Renderer.create() as renderer:
        return renderer.context.description

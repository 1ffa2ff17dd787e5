"""What compares photographs in this process: a GPU where there is one and the settings let it, or the processor."""

from typing import TYPE_CHECKING

from server.tasks.child import WorkerContext

if TYPE_CHECKING:
    from pipeline.settings import Settings
    from rig.render.compute import ComputeDevice
    from rig.render.renderer import Renderer

MOST_THREADS = (
    8  # of a processor that a GPU is faster than: of an H200 two threads take 1.5 times as long, 16 no longer
)


def matching_device(context: WorkerContext, chosen: "Settings", renderer: "Renderer") -> "ComputeDevice | None":
    """Returns the device that ``chosen.device`` names, made once a process; None for the processor, and for ``auto``
    where many threads share its loops. Raises ComputeUnavailable."""
    from pipeline.compute.threads import thread_count
    from rig.render.compute import open_device

    if chosen.device == "auto" and thread_count() > MOST_THREADS:
        return None

    description = renderer.context.description
    device: ComputeDevice | None = context.keep(
        f"device {chosen.device}", lambda: open_device(chosen.device, description)
    )
    return device

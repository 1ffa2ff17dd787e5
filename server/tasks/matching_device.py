"""What compares photographs in this process: a GPU where there is one and the settings let it, or the processor."""

from typing import TYPE_CHECKING

from server.tasks.child import WorkerContext

if TYPE_CHECKING:
    from pipeline.settings import Settings
    from rig.render.compute import ComputeDevice
    from rig.render.renderer import Renderer


def matching_device(context: WorkerContext, chosen: "Settings", renderer: "Renderer") -> "ComputeDevice | None":
    """Returns the device that ``chosen.device`` names, made once a process; None for the processor. Raises
    ComputeUnavailable."""
    from rig.render.compute import open_device

    description = renderer.context.description
    device: ComputeDevice | None = context.keep(
        f"device {chosen.device}", lambda: open_device(chosen.device, description)
    )
    return device

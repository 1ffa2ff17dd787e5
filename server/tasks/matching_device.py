"""Chooses what compares photographs in this process: a GPU or the processor."""

from typing import TYPE_CHECKING

from server.tasks.child import WorkerContext

if TYPE_CHECKING:
    from pipeline.settings import Settings
    from rig.render.compute import ComputeDevice
    from rig.render.renderer import Renderer

MOST_THREADS = 8  # of a processor that a GPU is faster than: of an H200 two threads take 1.5 times as long, 16 no
# longer


def matching_device(context: WorkerContext, chosen: "Settings", renderer: "Renderer") -> "ComputeDevice | None":
    """Opens the compute device that ``chosen.device`` names, once a process. Returns None if the processor compares:
    with the device ``cpu``, and with ``auto`` without a GPU or with more than ``MOST_THREADS`` threads. Raises
    ComputeUnavailable if ``gl`` was chosen and is not there."""
    from pipeline.compute.threads import thread_count
    from rig.render.compute import open_device

    if chosen.device == "auto" and thread_count() > MOST_THREADS:
        return None

    description = renderer.context.description
    device: ComputeDevice | None = context.keep(
        f"device {chosen.device}", lambda: open_device(chosen.device, description)
    )
    return device

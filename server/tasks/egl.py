"""Tests whether this machine has OpenGL, for drawing and for computing; runs in a child process."""

from rig.progress import Progress
from server.tasks.child import WorkerContext


def try_egl(context: WorkerContext, report: Progress) -> str:
    """Opens a GL context and returns the name of its device. Raises EglUnavailable."""
    from rig.render.context import GlContext  # without the renderer's NumPy: half the time

    gl = GlContext()
    try:
        return gl.description
    finally:
        gl.close()


def try_compute(context: WorkerContext, report: Progress) -> str:
    """Opens a compute device and returns a text that says if jobs use it by default. Raises ComputeUnavailable."""
    from rig.render.compute import ComputeDevice, is_software

    with ComputeDevice.create() as device:
        if is_software(device.description):
            return f"none; --device gl runs in software, slower than the processor: {device.description}"
        return f"compares photographs: {device.description}"

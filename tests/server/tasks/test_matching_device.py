"""Which device compares photographs."""

from dataclasses import replace

import pytest

from pipeline.settings import Settings
from rig.render.compute import ComputeDevice, is_software, open_device
from rig.render.renderer import Renderer
from server.tasks.child import WorkerContext
from server.tasks.matching_device import MOST_THREADS, matching_device

GPU, LLVMPIPE = "NVIDIA H200/PCIe/SSE2, 4.3.0 NVIDIA 580.159.04", "llvmpipe (LLVM 15.0.6, 256 bits), 4.5 Mesa 22.3.6"


@pytest.mark.parametrize(
    ("renderer", "software"),
    [
        (GPU, False),
        ("AMD Radeon RX 7900 (radeonsi, navi31), 4.6 Mesa 24.0.5", False),
        (LLVMPIPE, True),
        ("softpipe, 3.3 Mesa", True),
        ("Google SwiftShader, OpenGL ES 3.0", True),
    ],
)
def test_renderers_that_draw_with_the_processor_are_no_gpu(renderer: str, software: bool) -> None:
    assert is_software(renderer) == software


@pytest.mark.gl
def test_auto_leaves_software_alone_and_gl_takes_it() -> None:
    assert open_device("cpu", GPU) is None
    assert open_device("auto", LLVMPIPE) is None
    for device in (open_device("gl", LLVMPIPE), open_device("auto", GPU)):
        assert isinstance(device, ComputeDevice)
        device.close()


@pytest.mark.gl
def test_the_device_is_made_once_a_process_and_many_threads_need_none(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    context, settings = WorkerContext(), replace(Settings(), device="gl")
    first = matching_device(context, settings, renderer)
    assert first is not None
    assert matching_device(context, settings, renderer) is first
    context.close()
    monkeypatch.setenv("EIGENHEAD_THREADS", str(MOST_THREADS + 1))
    assert matching_device(WorkerContext(), Settings(), renderer) is None

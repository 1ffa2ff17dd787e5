"""What a job does, from a capture folder to the files of a result, in this process: a small studio picture set."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from pipeline.head_model.model import load_model
from pipeline.settings import Settings
from pipeline.view_checks.usable_views import TooFewViews
from rig.formats.captures.capture_folder import write_capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.progress import Progress, discard_progress
from rig.render.compute import ComputeDevice, is_software, open_device
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.sensor.preset import PRESET
from server.tasks.child import WorkerContext
from server.tasks.reconstruct import MOST_THREADS, matching_device, reconstruct_capture
from server.tasks.subjects import drawn_subject

pytestmark = [pytest.mark.slow, pytest.mark.gl]


@pytest.fixture(scope="module")
def shot(renderer: Renderer) -> SimulatedCapture:
    """Seven cameras at 410 x 307 pixels."""
    rng = np.random.default_rng(23)
    rig = default_layout().subset(("cam00", "cam01", "cam02", "cam03", "cam04", "cam06", "cam08")).scaled(0.4)
    return simulate(drawn_subject(load_model(), rng), rig, PRESET, rng, renderer=renderer)


def reconstruct(renderer: Renderer, folder: Path, report: Progress, **settings: str) -> None:
    """The job of ``folder``/capture."""
    context = WorkerContext()
    context.keep("renderer", lambda: renderer)
    places = {name: str(folder / name) for name in ("capture", "result", "cache")}
    reconstruct_capture(context, report, **places, model=None, settings=settings)


def test_a_capture_folder_becomes_a_head(renderer: Renderer, shot: SimulatedCapture, tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", shot.capture, shot.rig)
    stored = {"code": "scale-assumed", "message": "as if these cameras had been found from the photographs"}
    digest = hashlib.sha256((tmp_path / "capture" / "cameras.json").read_bytes()).hexdigest()
    (tmp_path / "capture" / "calibration.json").write_text(json.dumps({"cameras_sha256": digest, "told": [stored]}))
    heard: list[str] = []
    reconstruct(renderer, tmp_path, lambda stage, fraction: heard.append(stage), detail="span")
    order, known = list(dict.fromkeys(heard)), ["read", "segmentation", "fit", "texture", "write"]
    assert [stage for stage in order if stage in known] == known
    assert order[-1] == "write"  # nothing is called done before its files are there
    report = json.loads((tmp_path / "result" / "report.json").read_text())
    assert all(camera["used"] for camera in report["cameras"].values())
    assert report["warnings"][0] == {**stored, "parameters": {}}
    assert {warning["code"] for warning in report["warnings"][1:]} <= {"view", "bust-guessed"}
    face = shot.scene.head.vertices[shot.scene.photographed]
    away, _ = KDTree(read_mesh(tmp_path / "result" / "head.ply").vertices).query(face)
    # A pixel is 2.3 mm at the head here, and outlines are met to half a one.
    assert np.median(away) < 1.2
    assert np.quantile(away, 0.95) < 4.6
    assert any((tmp_path / "cache").rglob("*"))  # the silhouettes, for the next job


def test_an_empty_studio_is_refused_without_result(renderer: Renderer, shot: SimulatedCapture, tmp_path: Path) -> None:
    nobody = {name: plates[0] for name, plates in shot.capture.backgrounds.items()}
    write_capture(tmp_path / "capture", replace(shot.capture, images=nobody, features={}), shot.rig)
    with pytest.raises(TooFewViews, match="cam06"):
        reconstruct(renderer, tmp_path, discard_progress)
    assert not (tmp_path / "result").exists()


GPU, LLVMPIPE = "NVIDIA H200/PCIe/SSE2, 4.3.0 NVIDIA 580.159.04", "llvmpipe (LLVM 15.0.6, 256 bits), 4.5 Mesa 22.3.6"


@pytest.mark.parametrize(
    ("description", "software"),
    [
        (GPU, False),
        ("AMD Radeon RX 7900 (radeonsi, navi31), 4.6 Mesa 24.0.5", False),
        (LLVMPIPE, True),
        ("softpipe, 3.3 Mesa", True),
        ("Google SwiftShader, OpenGL ES 3.0", True),
    ],
)
def test_renderers_that_draw_with_the_processor_are_no_gpu(description: str, software: bool) -> None:
    assert is_software(description) == software


@pytest.mark.gl
def test_auto_leaves_software_alone_and_gl_takes_it() -> None:
    assert open_device("cpu", GPU) is None
    assert open_device("auto", LLVMPIPE) is None
    for device in (open_device("gl", LLVMPIPE), open_device("auto", GPU)):
        assert isinstance(device, ComputeDevice)
        device.close()


@pytest.mark.gl
def test_a_device_is_made_once_and_many_threads_need_none(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    context, settings = WorkerContext(), replace(Settings(), device="gl")
    first = matching_device(context, settings, renderer)
    assert first is not None
    assert matching_device(context, settings, renderer) is first
    context.close()
    monkeypatch.setenv("EIGENHEAD_THREADS", str(MOST_THREADS + 1))
    assert matching_device(WorkerContext(), Settings(), renderer) is None

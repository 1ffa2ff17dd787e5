"""What a capture of large pictures costs: eleven photographs of 24 Mpx with a clean plate each, one command, time and
peak memory. They are drawn at 7 Mpx and enlarged: detail costs, truth does not.

python -m tests.laboratory large_pictures write CAPTURE
python -m tests.laboratory large_pictures time CAPTURE --detail photo --surface head
"""

import json
import resource
import subprocess
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from pipeline.head_model.model import load_model
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.pictures.images import write_image
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.sensor.preset import PRESET
from server.processes import python_command, python_environment
from server.tasks.subjects import drawn_subject

DRAWN, WRITTEN = 3.0, 5.5234375  # times 1024 x 768: 7 Mpx, and 5656 x 4242 = 24 Mpx
TIME_LIMIT_S = 1800


def run(
    what: Literal["write", "time"],
    capture: Path,
    scratch: Path,
    *,
    detail: Literal["span", "kernel", "photo", "fine"] | None = None,
    surface: Literal["head", "bust", "both"] | None = None,
) -> dict[str, Any]:
    """Writes a capture, or returns what a job on it costs."""
    if what == "write":
        rig = write(capture)
        return {"figures": {"cameras": len(rig), "width": rig.cameras[0].intrinsics.width}}
    options = [f"--{name}={value}" for name, value in (("detail", detail), ("surface", surface)) if value]
    return {"figures": cost(capture, scratch, options)}


def write(folder: Path, seed: int = 1) -> Rig:
    """The capture folder, its pictures JPEG as cameras write them."""
    rng = np.random.default_rng(seed)
    drawn = default_layout().scaled(DRAWN)
    preset = replace(PRESET, plates=1, defocus_px=PRESET.defocus_px * DRAWN)
    with Renderer.create() as renderer:
        taken = simulate(drawn_subject(load_model(), rng), drawn, preset, rng, renderer=renderer)
    rig = drawn.scaled(WRITTEN / DRAWN)
    write_rig(rig, folder / "cameras.json")
    for camera in rig:
        size = (camera.intrinsics.width, camera.intrinsics.height)
        shots = {"images": taken.capture.images[camera.name], "background": taken.capture.backgrounds[camera.name][0]}
        for kind, picture in shots.items():
            write_image(folder / kind / f"{camera.name}.jpg", cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC))
    return rig


def cost(capture: Path, scratch: Path, options: Sequence[str]) -> dict[str, float]:
    """Seconds, seconds of all cores together, and GB of memory at most, of ``eigenhead reconstruct``. The job's trace
    says what it took at most: the kernel's figure for children begins with what this process had."""
    trace, start = scratch / "trace.json", time.perf_counter()
    words = [*python_command("cli", "reconstruct"), str(capture), "--out", str(scratch / "head"), "--trace", str(trace)]
    subprocess.run([*words, *options], check=True, env=python_environment(), timeout=TIME_LIMIT_S)
    took, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    peak_mb = json.loads(trace.read_text())["peak_memory_mb"]
    return {"seconds": took, "cpu_s": used.ru_utime + used.ru_stime, "peak_gb": peak_mb / 1024}

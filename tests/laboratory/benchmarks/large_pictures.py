"""What a capture of large pictures costs: eleven photographs of 24 Mpx with a clean plate each, one command, time and
peak memory. From the root:

python -m tests.laboratory.benchmarks.large_pictures write CAPTURE        drawn at 7 Mpx and enlarged: detail costs, truth does not
python -m tests.laboratory.benchmarks.large_pictures time CAPTURE [--detail photo --surface head]
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from pipeline.head_model.model import load_model
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.pictures.images import write_image
from rig.image import ImageRgb
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.sensor.preset import PRESET
from server.processes import python_environment
from server.tasks.subjects import drawn_subject

DRAWN, WRITTEN = 3.0, 5.5234375  # times 1024 x 768: 7 Mpx, and 5656 x 4242 = 24 Mpx


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
        picture, plate = taken.capture.images[camera.name], taken.capture.backgrounds[camera.name][0]
        write_image(folder / "images" / f"{camera.name}.jpg", _enlarged(picture, size))
        write_image(folder / "background" / f"{camera.name}.jpg", _enlarged(plate, size))
    return rig


def _enlarged(picture: ImageRgb, size: tuple[int, int]) -> ImageRgb:
    return cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)


def cost(capture: Path, *options: str) -> tuple[float, float, float]:
    """Seconds, seconds of all cores together, and GB of memory at most, of ``eigenhead reconstruct``. The job's trace
    says what it took at most: the kernel's figure for children begins with what this process had."""
    with tempfile.TemporaryDirectory() as folder:
        trace = Path(folder, "trace.json")
        command = [sys.executable, "-m", "server.cli", "reconstruct", str(capture), "--out", f"{folder}/head"]
        start = time.perf_counter()
        subprocess.run([*command, "--trace", str(trace), *options], check=True, env=python_environment())
        took = time.perf_counter() - start
        peak_mb = json.loads(trace.read_text())["peak_memory_mb"]
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return took, used.ru_utime + used.ru_stime, peak_mb / 1024


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("write", "time"))
    parser.add_argument("capture", type=Path)
    arguments, options = parser.parse_known_args()
    if arguments.what == "write":
        found = write(arguments.capture)
        sys.stdout.write(f"{len(found)} cameras of {found.cameras[0].intrinsics.width} pixels across\n")
    else:
        took_s, cpu_s, most_gb = cost(arguments.capture, *options)
        sys.stdout.write(f"{took_s:.1f} s, {cpu_s:.1f} s of all cores together, {most_gb:.2f} GB\n")

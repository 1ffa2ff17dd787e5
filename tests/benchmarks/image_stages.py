"""Seconds of a job's stages, from image files to result files, warm: medians and least of several rounds; peak memory.

python -m tests.benchmarks.image_stages --detail photo --surface head --json

``segmentation`` is eleven 1024 x 768 images, ``texture`` colours the model's full mesh from them; ``hull``, which no
job needs, is the visual hull of the silhouettes. ``total`` is from opening the first file to the last one written,
``cpu`` the processor seconds of it in all threads, which a busy machine stretches least.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.eigenheads.model import load_model
from pipeline.multiview.visual_hull import visual_hull
from pipeline.reconstruct import reconstruct
from pipeline.results.write import write_result
from pipeline.settings import Settings
from rig.formats.capture_folder import read_capture
from rig.render.renderer import Renderer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=Path("../shared/data/captures/scan-a"))
    parser.add_argument("--detail", choices=("span", "kernel", "photo", "fine"), default="span")
    parser.add_argument("--surface", choices=("head", "bust", "both"), help="both where nothing is asked")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    model, settings = load_model(), replace(Settings(), detail=arguments.detail)
    if arguments.surface:
        settings = replace(settings, outputs=replace(settings.outputs, surface=arguments.surface))
    rounds: list[dict[str, float]] = []
    own: dict[str, float] = {}
    with Renderer.create() as renderer, tempfile.TemporaryDirectory() as scratch:
        for _ in range(1 + arguments.rounds):
            started, spent = time.perf_counter(), time.process_time()
            capture, rig = read_capture(arguments.capture)
            opened = time.perf_counter()
            result = reconstruct(capture, rig, model, settings, renderer=renderer, report=lambda *_: None)
            found = time.perf_counter()
            write_result(Path(scratch), result, capture)
            written, spent = time.perf_counter(), time.process_time() - spent
            visual_hull(result.silhouettes, rig)
            hull = time.perf_counter() - written
            own = {"read": opened - started, "write": written - found, "total": written - started}
            own |= {"cpu": spent, "hull": hull}
            rounds.append({**result.seconds, **own})
    del rounds[0]  # it compiles, or reads what was compiled
    stages = ["read", *(name for name in rounds[0] if name not in own), "write", "total", "cpu", "hull"]
    median = {name: round(float(np.median([row[name] for row in rounds])), 3) for name in stages}
    least = {name: round(min(row[name] for row in rounds), 3) for name in stages}
    found = {"rounds": arguments.rounds, "detail": arguments.detail, "median_s": median, "least_s": least}
    found["peak_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024  # kB on Linux
    if arguments.json:
        json.dump(found, sys.stdout)
        sys.stdout.write("\n")
    else:
        sys.stdout.write("".join(f"{name:<14} {median[name]:7.3f} s   least {least[name]:.3f}\n" for name in stages))
        sys.stdout.write(f"peak memory    {found['peak_memory_mb']} MB\n")


if __name__ == "__main__":
    main()

"""Seconds of the depth stage by compiled loops and by compute shaders, and how far apart their depths are.

python -m tests.laboratory depth_devices --rounds 3
EIGENHEAD_THREADS=2 python -m tests.laboratory depth_devices --capture ../shared/data/captures/draw-b

Both start from the same fit. ``depth`` is the whole stage (highlights taken out, depth maps, parts and points of them).
The first round, which compiles loops and shaders, is not counted.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.compute.threads import thread_count
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import fit_shape
from pipeline.settings import Settings
from pipeline.stages.alignment import align_head
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import Depth, measure_depth
from pipeline.stages.faces import find_faces
from pipeline.stages.recorder import Recorder
from pipeline.stages.views import find_views
from rig.formats.captures.capture_folder import read_capture
from rig.render.compute import ComputeDevice
from rig.render.renderer import Renderer


def run(
    model: HeadModel, renderer: Renderer, *, capture: Path = Path("../shared/data/captures/scan-a"), rounds: int = 3
) -> dict[str, Any]:
    """Returns the figures of this module."""
    shot, rig = read_capture(capture)
    with ComputeDevice.create() as device:
        context = ReconstructionContext(shot, rig, model, Settings(), renderer)
        views = find_views(context).product
        alignment = align_head(context, views, find_faces(context, views.capture).product).product
        labels, head = fit_shape(Recorder(context), views, alignment)

        def measured(chosen: ComputeDevice | None) -> tuple[Depth, float]:
            began = time.perf_counter()
            found = measure_depth(replace(context, device=chosen), views, head, labels).product
            return found, time.perf_counter() - began

        taken = [(measured(None), measured(device)) for _ in range(1 + rounds)][1:]
    (by_loops, _), (by_shaders, _) = taken[-1]
    seconds = [float(np.median([each[k][1] for each in taken])) for k in (0, 1)]
    found = {
        "device": device.description,
        "threads": thread_count(),
        "loops_s": seconds[0],
        "shaders_s": seconds[1],
        "speedup": seconds[0] / seconds[1],
        **differences(by_loops, by_shaders),
    }
    return {"figures": found}


def differences(by_loops: Depth, by_shaders: Depth) -> dict[str, float]:
    """Of the depths (mm) that both know, and the share that only one knows."""
    pairs = list(zip(by_loops.maps, by_shaders.maps, strict=True))
    apart = np.concatenate([np.abs(a.depth_mm - b.depth_mm)[a.known & b.known] for a, b in pairs])
    one_only = sum(np.count_nonzero(a.known ^ b.known) for a, b in pairs)
    return {
        "median_apart_mm": float(np.median(apart)),
        "p99_apart_mm": float(np.quantile(apart, 0.99)),
        "known_by_one_only_share": one_only / max(sum(np.count_nonzero(a.known) for a, _ in pairs), 1),
    }

"""Calibration from photographs alone, judged by published poses or by the simulated studio's truth.

python -m tests.laboratory scene_calibration buddha --every 2 --size 0.5
python -m tests.laboratory scene_calibration studio --captures 10 --views 30 --masks
"""

import time
from typing import Annotated, Any, Literal

import numpy as np

from calibration.adjustment.gauge import image_distance
from calibration.result import CalibrationRefused
from rig.progress import Progress
from tests.support.scene_calibrations import buddha, studio


def run(
    what: Literal["buddha", "studio"],
    report: Progress,
    *,
    every: Annotated[int, "which of the Buddha's photographs: all, every second, ..."] = 1,
    size: Annotated[float, "the Buddha's photographs made smaller"] = 1.0,
    captures: Annotated[int, "of the studio"] = 10,
    views: Annotated[int, "of a capture of the studio"] = 30,
    masks: Annotated[bool, "beside the studio's photographs"] = False,
) -> dict[str, Any]:
    """Returns the figures of the Buddha, or of each capture of the studio by its seed."""
    if what == "buddha":
        return {"figures": judge_buddha(every, size)}
    found = {}
    for seed in range(1, captures + 1):
        report(f"seed {seed}", (seed - 1) / captures)
        found[f"seed {seed}"] = judge_studio(seed, views, masks=masks)
    return {"figures": found}


def judge_buddha(every: int, size: float) -> dict[str, Any]:
    """Compares the cameras with the published poses."""
    start = time.process_time()
    found, agrees = buddha(every, size)
    return {
        "joined": len(found.rig),
        "left_out": len(found.left_out),
        **{key: found.figures()[key] for key in ("points", "rms_px", "noise_px")},
        "claimed_px": float(np.median(found.uncertainty.pose_sigma_px)),
        "published": str(agrees),
        "cpu_s": time.process_time() - start,
    }


def judge_studio(seed: int, views: int, *, masks: bool) -> dict[str, Any]:
    """Compares the cameras with the truth, after a similarity."""
    start = time.process_time()
    try:
        found, truth = studio(seed, views, masks=masks)
    except CalibrationRefused as refusal:
        return {"refused": "; ".join(map(str, refusal.reasons))}
    true = truth.subset(found.rig.names)
    away = image_distance(found.rig, true, scale=True)
    sizes = [np.ptp([camera.centre_world for camera in rig], axis=0).max() for rig in (found.rig, true)]
    row = {
        "joined": len(found.rig),
        "poses_px_median": float(np.median(away)),
        "poses_px_worst": float(away.max()),
        "claimed_px": float(np.median(found.uncertainty.pose_sigma_px)),
        "assumed_scale": float(sizes[0] / sizes[1]),
        "cpu_s": time.process_time() - start,
    }
    return row if found.refinement is None else row | {"refinement": str(found.refinement)}

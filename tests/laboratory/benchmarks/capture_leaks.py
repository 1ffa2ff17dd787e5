"""Captures in a row from the studio's devices: does anything pile up?

python -m tests.laboratory capture_leaks --captures 500 --width 1024 --height 768

One session takes the captures and writes each folder over the last one. Printed are resident memory, threads and open
descriptors of the process (studio and session together) every fiftieth capture, their growth from the first tenth to
the end, and the seconds of a capture.
"""

import gc
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from rig.acquisition.commands import capture_with
from rig.acquisition.session import RigSession
from rig.acquisition.shot import ShotFailed
from rig.camera import Camera, Intrinsics
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.rig_toml import read_rig_config
from rig.geometry import RigidTransform
from rig.progress import Progress
from rig.rig import Rig
from rig.studio.devices.serve import StudioDevices
from tests.support.textured_studio import NAMES, FlatStudio


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def measure() -> dict[str, float]:
    gc.collect()
    return {
        "resident_mb": round(resident_mb(), 1),
        "threads": threading.active_count(),
        "descriptors": len(list(Path("/proc/self/fd").iterdir())),
    }


def run(scratch: Path, report: Progress, *, captures: int = 500, width: int = 320, height: int = 240) -> dict[str, Any]:
    """Takes the captures. Returns the figures of this module."""
    lens = Intrinsics(width, height, 2.0 * width, 2.0 * width, (width - 1) / 2, (height - 1) / 2)
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1200.0]))
    write_rig(Rig(tuple(Camera(name, lens, pose) for name in NAMES)), scratch / "cameras.json")
    empty, seated = FlatStudio(False, width, height), FlatStudio(True, width, height)
    with StudioDevices(scratch, NAMES, empty, seated, calibration="cameras.json") as studio:
        return {"figures": {"captures": captures, "size": [width, height], **_series(studio, captures, report)}}


def _series(studio: StudioDevices, captures: int, report: Progress) -> dict[str, object]:
    config = read_rig_config(studio.folder / "rig.toml")
    taken_s: list[float] = []
    refused: dict[str, int] = {}
    spreads_s: list[float] = []
    marks: list[dict[str, float]] = []
    with RigSession(config) as session:
        session.warm_up()
        session.take_plates()
        studio.seat(True)
        for index in range(1, captures + 1):
            out = studio.folder / "capture"
            shutil.rmtree(out, ignore_errors=True)
            started_s = time.monotonic()
            try:
                shot = capture_with(session, out)
                spreads_s.append(shot.certificate.spread_s or 0.0)
            except ShotFailed as error:  # a late frame on a loaded machine: named, and counted here
                for fault in error.faults:
                    refused[fault.code] = refused.get(fault.code, 0) + 1
            taken_s.append(time.monotonic() - started_s)
            if index % max(1, captures // 10) == 0:
                marks.append({"capture": index, **measure()})
                report("captures", index / captures)
    growth = {key: round(marks[-1][key] - marks[0][key], 1) for key in ("resident_mb", "threads", "descriptors")}
    return {
        "complete": len(spreads_s),
        "refused": refused,
        "seconds": {"median": round(float(np.median(taken_s)), 3), "max": round(max(taken_s), 3)},
        "spread_ms": {"median": round(float(np.median(spreads_s)) * 1e3, 2), "max": round(max(spreads_s) * 1e3, 2)},
        "first": marks[0],
        "last": marks[-1],
        "growth": growth,
    }

"""Captures in a row from the studio's devices, each folder over the last one: does anything pile up?

Memory, threads and open descriptors are those of the process, studio and session together."""

import gc
import shutil
import threading
from collections import Counter
from contextlib import ExitStack
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
from tests.laboratory.experiments.surface.pores import resident_mb
from tests.support.textured_studio import NAMES, FlatStudio


def run(scratch: Path, report: Progress, *, captures: int = 500, width: int = 320, height: int = 240) -> dict[str, Any]:
    """Takes the captures. Returns the figures of this module."""
    lens = Intrinsics(width, height, 2.0 * width, 2.0 * width, (width - 1) / 2, (height - 1) / 2)
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1200.0]))
    write_rig(Rig(tuple(Camera(name, lens, pose) for name in NAMES)), scratch / "cameras.json")
    empty, seated = FlatStudio(False, width, height), FlatStudio(True, width, height)
    spreads_s, refused, marks = list[float](), Counter[str](), list[dict[str, float]]()
    with ExitStack() as stack:
        studio = stack.enter_context(StudioDevices(scratch, NAMES, empty, seated, calibration="cameras.json"))
        with RigSession(read_rig_config(studio.folder / "rig.toml")) as session:
            session.warm_up()
            session.take_plates()
            studio.seat(True)
            for index in range(1, captures + 1):
                shutil.rmtree(studio.folder / "capture", ignore_errors=True)
                try:
                    spreads_s.append(capture_with(session, studio.folder / "capture").certificate.spread_s or 0.0)
                except ShotFailed as error:  # a late frame on a loaded machine: named, and counted here
                    refused.update(fault.code for fault in error.faults)
                if index % max(1, captures // 10) == 0:
                    gc.collect()
                    open_files = len(list(Path("/proc/self/fd").iterdir()))
                    used = {
                        "resident_mb": resident_mb(),
                        "threads": threading.active_count(),
                        "descriptors": open_files,
                    }
                    marks.append({key: round(value, 1) for key, value in used.items()})
                    report("captures", index / captures)
    figures = {"captures": captures, "complete": len(spreads_s), "refused": dict(refused), "first": marks[0]}
    figures |= {"size": [width, height], "growth": {key: round(marks[-1][key] - marks[0][key], 1) for key in marks[0]}}
    return {"figures": figures | {"spread_ms": round(max(spreads_s, default=0.0) * 1e3, 2)}}

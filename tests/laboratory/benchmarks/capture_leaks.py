"""Captures in a row from the studio's devices: does anything pile up?

    python tests/laboratory/benchmarks/capture_leaks.py [--captures 500] [--width 1024 --height 768] [--json]

One session takes the captures and writes each folder over the last one. Printed are resident memory, threads and open
descriptors of the process (studio and session together) every fiftieth capture, their growth from the first tenth to
the end, and the seconds of a capture.
"""

import argparse
import gc
import json
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from rig.acquisition.commands import capture_with
from rig.acquisition.session import RigSession
from rig.acquisition.shot import ShotFailed
from rig.camera import Camera, Intrinsics
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.rig_toml import read_rig_config
from rig.geometry import RigidTransform
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


def main() -> None:
    parser = argparse.ArgumentParser(description="Captures in a row: does anything pile up?")
    parser.add_argument("--captures", type=int, default=500)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = run(options.captures, options.width, options.height, quiet=options.json)
    sys.stdout.write(json.dumps(result, indent=None if options.json else 1) + "\n")


def run(captures: int, width: int, height: int, *, quiet: bool) -> dict[str, object]:
    folder = Path(tempfile.mkdtemp())
    lens = Intrinsics(width, height, 2.0 * width, 2.0 * width, (width - 1) / 2, (height - 1) / 2)
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1200.0]))
    write_rig(Rig(tuple(Camera(name, lens, pose) for name in NAMES)), folder / "cameras.json")
    empty, seated = FlatStudio(False, width, height), FlatStudio(True, width, height)
    try:
        with StudioDevices(folder, NAMES, empty, seated, calibration="cameras.json") as studio:
            return {"captures": captures, "size": [width, height], **_series(studio, captures, quiet)}
    finally:
        shutil.rmtree(folder)


def _series(studio: StudioDevices, captures: int, quiet: bool) -> dict[str, object]:
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
                if not quiet:
                    sys.stderr.write(f"{marks[-1]}\n")
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


if __name__ == "__main__":
    main()

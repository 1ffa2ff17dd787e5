"""Two checkouts on the same captures: errors where a truth is beside a capture, outlines, CPU seconds.

python -m tests.laboratory side_by_side ../before CAPTURE... [--runs 3] [--json]

Each checkout's `reconstruct` runs in a process of its own with this environment, its order changing from run to run, so
that a busy machine favours none. Distances are those of the benchmark `captures`; medians over the runs.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from pipeline.geometry.surface_index import SurfaceIndex
from rig.errors import EigenheadError
from rig.formats.meshes.mesh_file import read_mesh
from rig.progress import Progress
from tests.laboratory.experiments.paper.detail import read_known, surface_error

HERE = Path(__file__).resolve().parents[3]
TIME_LIMIT_S = 1800


def run(
    other: Annotated[Path, "compared"], captures: Sequence[Path], scratch: Path, report: Progress, *, runs: int = 1
) -> dict[str, Any]:
    """Returns for each capture ``<quantity>: [before, now]``."""
    checkouts = {"before": other.resolve(), "now": HERE}
    found, lines = {}, list[str]()
    for done, capture in enumerate(captures):
        rows: dict[str, list[dict[str, float]]] = {"before": [], "now": []}
        for number in range(runs):
            for name in sorted(rows, reverse=number % 2 == 1):
                report(f"{capture.name} {name}", (done + number / runs) / len(captures))
                cpu_s = reconstructed(checkouts[name], capture.resolve(), scratch / name)
                rows[name].append({"cpu_s": cpu_s} | measured(capture, scratch / name))
        figures = {
            key: [round(median(row[key] for row in rows[name]), 4) for name in ("before", "now")]
            for key in rows["now"][0]
            if all(key in row for name in rows for row in rows[name])
        }
        for key, (before, now) in figures.items():
            ratio = f"{now / before:8.3f}" if before else ""
            lines.append(f"{capture.name:<16} {key:<12}{before:9.3f}{now:9.3f}{ratio}")
        apart = apart_mm(scratch / "before", scratch / "now")
        lines.append(f"{capture.name:<16} apart_mm    {apart:9.3f}")
        found[capture.name] = figures | {"apart_mm": [apart]}
    return {"figures": found, "lines": lines}


def reconstructed(checkout: Path, capture: Path, out: Path) -> float:
    """Makes one head in a child process. Returns its CPU seconds, those of its own children included."""
    shutil.rmtree(out, ignore_errors=True)
    before = os.times()
    command = [sys.executable, "-m", "server.cli", "reconstruct", str(capture), "--out", str(out)]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, timeout=TIME_LIMIT_S)
    after = os.times()
    if done.returncode:
        raise EigenheadError(f"{checkout.name} on {capture.name}: {done.stderr.strip()[-2000:]}")
    return after.children_user + after.children_system - before.children_user - before.children_system


def measured(capture: Path, out: Path) -> dict[str, float]:
    """Returns the outline's residual, and the distances to the truth if one is beside the capture."""
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    figures = {"outline_px": median(of["contour_rms_px"] for of in report["cameras"].values() if of["used"])}
    if capture.with_name(f"{capture.name}.truth").is_dir():
        figures |= surface_error(read_known(capture), read_mesh(out / "head.ply"))
    return figures


def apart_mm(before: Path, now: Path) -> float:
    """Returns the median distance of the vertices of one head to the other's surface."""
    first, second = (read_mesh(folder / "head.ply") for folder in (before, now))
    return round(median(SurfaceIndex(first.vertices, first.faces, 1.0).closest(second.vertices).distances), 4)

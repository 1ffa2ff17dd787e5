"""Two checkouts on the same captures: errors where a truth is beside a capture, outlines, CPU seconds.

python -m tests.laboratory.benchmarks.side_by_side ../before CAPTURE... [--runs 3] [--json]

Each checkout's `reconstruct` runs in a process of its own with this environment, its order changing from run to run, so
that a busy machine favours none. Distances are those of `tests.laboratory.benchmarks.captures`; medians over the runs.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

from pipeline.geometry.surface_index import SurfaceIndex
from rig.formats.meshes.mesh_file import read_mesh
from tests.laboratory.experiments.paper.detail import read_known, surface_error

HERE = Path(__file__).resolve().parents[2]
TIME_LIMIT_S = 1800


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="the checkout to compare with")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    checkouts = {"before": arguments.other.resolve(), "now": HERE}
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for capture in arguments.captures:
            rows: dict[str, list[dict[str, float]]] = {"before": [], "now": []}
            for run in range(arguments.runs):
                for name in sorted(rows, reverse=run % 2 == 1):
                    out = Path(folder, name)
                    cpu_s = reconstructed(checkouts[name], capture.resolve(), out)
                    rows[name].append({"cpu_s": cpu_s} | measured(capture, out))
            found[capture.name] = {
                key: [round(median(row[key] for row in rows[name]), 4) for name in ("before", "now")]
                for key in rows["now"][0]
                if all(key in row for name in rows for row in rows[name])
            } | {"apart_mm": [apart_mm(Path(folder, "before"), Path(folder, "now"))]}
            if not arguments.json:
                show(capture.name, found[capture.name])
    if arguments.json:
        json.dump({"figures": found}, sys.stdout)
        sys.stdout.write("\n")


def reconstructed(checkout: Path, capture: Path, out: Path) -> float:
    """Makes one head in a child process. Returns its CPU seconds, those of its own children included."""
    shutil.rmtree(out, ignore_errors=True)
    before = os.times()
    command = [sys.executable, "-m", "server.cli", "reconstruct", str(capture), "--out", str(out)]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, timeout=TIME_LIMIT_S)
    after = os.times()
    if done.returncode:
        sys.exit(f"{checkout.name} on {capture.name}: {done.stderr.strip()[-2000:]}")
    return after.children_user + after.children_system - before.children_user - before.children_system


def measured(capture: Path, out: Path) -> dict[str, float]:
    """Returns the outline's residual, and the distances to the truth if one is beside the capture."""
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    figures = {
        "outline_px": median(camera["contour_rms_px"] for camera in report["cameras"].values() if camera["used"])
    }
    if capture.with_name(f"{capture.name}.truth").is_dir():
        figures |= surface_error(read_known(capture), read_mesh(out / "head.ply"))
    return figures


def apart_mm(before: Path, now: Path) -> float:
    """Returns the median distance of the vertices of one head to the other's surface."""
    meshes = [read_mesh(folder / "head.ply") for folder in (before, now)]
    return round(
        median(SurfaceIndex(meshes[0].vertices, meshes[0].faces, 1.0).closest(meshes[1].vertices).distances), 4
    )


def show(name: str, figures: dict[str, list[float]]) -> None:
    """Prints the figures of one capture: before, now, and their ratio."""
    for key, values in figures.items():
        ratio = f"{values[1] / values[0]:8.3f}" if len(values) == 2 and values[0] else ""
        sys.stdout.write(f"{name:<16} {key:<12}" + "".join(f"{value:9.3f}" for value in values) + ratio + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()

"""Errors of the captures with a truth beside them at every level of detail, as delivered (world frame, not realigned).

python -m tests.laboratory.benchmarks.captures --json
python -m tests.laboratory.benchmarks.captures --noise 6 --levels photo fine

With one thread of BLAS, as jobs run: rounding by two of them moves three frontal cameras from 0.53 to 0.48 mm.
Distances from the true face region to the head's surface, mm, weighted by area; default model, the project's own masks.
"""

import argparse
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

from pipeline.head_model.model import load_model
from pipeline.reconstruct import reconstruct
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.render.renderer import Renderer
from tests.laboratory.experiments.paper.detail import read_known, surface_error
from tests.support.noisy_captures import noisier

LEVELS = ("span", "kernel", "photo", "fine")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data/captures"))
    parser.add_argument("--levels", nargs="+", choices=LEVELS, default=LEVELS)
    parser.add_argument("--noise", type=float, default=0.0, help="levels of 255 that are added to pictures and plates")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    model, found = load_model(), {}
    with Renderer.create() as renderer:
        for truth in sorted(arguments.captures.glob("*.truth")):
            known = read_known(truth.with_suffix(""))
            capture = noisier(known.capture, arguments.noise) if arguments.noise else known.capture
            for level in arguments.levels:
                settings = replace(Settings(), detail=level, outputs=OutputSettings(surface="head"))
                head = reconstruct(ReconstructionContext(capture, known.rig, model, settings, renderer))
                for name, value in surface_error(known, head.mesh_world).items():
                    found[f"{known.name}_{level}_{name}"] = round(value, 4)
    if arguments.json:
        json.dump({"figures": found}, sys.stdout)
        sys.stdout.write("\n")
    else:
        sys.stdout.write("".join(f"{name:<28} {value:.3f}\n" for name, value in found.items()))


if __name__ == "__main__":
    main()

"""How close do silhouettes bring cameras back that are off by 0.5 px, and do they leave exact ones alone?

``python -m tests.benchmarks.silhouette_refinement [--seeds 3] [--captures 5] [--error-px 0.5] [--json]``. Every seed
has its own subjects (heads of the model with the studio's hair and shirts) and its own camera errors. Distances are RMS
over the cameras of ``calibration.gauge.image_distance`` to the truth; ``no_scale`` leaves out the rig's scale, which no
silhouette shows.
"""

import argparse
import json
import sys
import time

import numpy as np

from calibration.gauge import image_distance
from calibration.silhouette_refinement import refine
from rig.layout import Rig
from rig.render.renderer import Renderer
from rig.studio.layout import default_layout
from tests.calibration.silhouette_subjects import captures_of, disturbed, rms


def run(renderer: Renderer, rig: Rig, seed: int, captures: int, error_px: float) -> list[dict[str, object]]:
    """Figures from disturbed and from exact cameras."""
    rng = np.random.default_rng(seed)
    seen = list(captures_of(renderer, rig, captures, rng))
    rows = []
    for start in (disturbed(rig, error_px, rng), rig):
        began = time.perf_counter()
        found = refine(seen, start)
        rows.append(
            {
                "seed": seed,
                "start_px": round(rms(image_distance(start, rig)), 3),
                "result_px": round(rms(image_distance(found.rig, rig)), 3),
                "result_no_scale_px": round(rms(image_distance(found.rig, rig, scale=True)), 3),
                "proposed_change_px": round(rms(np.array(list(found.change_px.values()))), 3),
                "kept": found.kept,
                "held_out_px": [round(found.before_px, 3), round(found.after_px, 3)],
                "seconds": round(time.perf_counter() - began, 1),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="Cameras brought back by silhouettes.")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--captures", type=int, default=5)
    parser.add_argument("--error-px", type=float, default=0.5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with Renderer.create() as renderer:
        for seed in range(options.seeds):
            for row in run(renderer, default_layout(), seed, options.captures, options.error_px):
                text = json.dumps(row) if options.json else "  ".join(f"{k} {v}" for k, v in row.items())
                sys.stdout.write(text + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()

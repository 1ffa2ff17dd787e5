"""How often does the drift watch name a camera that was turned, and how often one that was not?

``python -m tests.benchmarks.drift_alarms [--captures 200] [--turn-deg 0.2] [--noise-px 0.2] [--json]``. Every capture
is another subject (a head of the model with the studio's hair and shirt) and another calibration error; in every other
one a random camera is turned by ``--turn-deg`` about a random axis across its view. ``false_alarm_captures`` are
captures in which a camera is named that was not turned, whether or not another was.
"""

import argparse
import json
import sys
from dataclasses import replace

import numpy as np

from pipeline.drift import find_drift
from rig.geometry import RigidTransform, rotation_from_vector
from rig.layout import Rig
from rig.render.renderer import Renderer
from rig.studio.layout import default_layout
from tests.calibration.silhouette_subjects import captures_of, disturbed


def turned(rig: Rig, name: str, turn_deg: float, rng: np.random.Generator) -> Rig:
    around = rng.uniform(0.0, 2.0 * np.pi)
    vector = np.radians(turn_deg) * np.array([np.cos(around), np.sin(around), 0.0])
    motion = RigidTransform(rotation_from_vector(vector), np.zeros(3))
    return Rig(tuple(replace(c, camera_from_world=motion @ c.camera_from_world) if c.name == name else c for c in rig))


def run(captures: int, turn_deg: float, noise_px: float, seed: int = 7) -> dict[str, object]:
    rig, rng = default_layout(), np.random.default_rng(seed)
    named = moved = false = 0
    with Renderer.create() as renderer:
        for k, seen in enumerate(captures_of(renderer, rig, captures, rng.spawn(1)[0])):
            believed, culprit = disturbed(rig, noise_px, rng), None
            if k % 2 == 0:
                culprit = str(rng.choice(rig.names))
                believed = turned(believed, culprit, turn_deg, rng)
                moved += 1
            found = {drift.camera for drift in find_drift(seen, believed)}
            named += culprit in found
            false += bool(found - {culprit})
    return {
        "captures": captures,
        "moved": moved,
        "named": named,
        "share_named": round(named / max(1, moved), 3),
        "false_alarm_captures": false,
        "false_alarm_share": round(false / max(1, captures), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Cameras named by the drift watch.")
    parser.add_argument("--captures", type=int, default=200)
    parser.add_argument("--turn-deg", type=float, default=0.2)
    parser.add_argument("--noise-px", type=float, default=0.2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = run(options.captures, options.turn_deg, options.noise_px)
    sys.stdout.write(json.dumps(result, indent=None if options.json else 1) + "\n")


if __name__ == "__main__":
    main()

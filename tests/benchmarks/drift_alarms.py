"""How often does the drift watch name a camera that was turned, and how often one that was not?

``python -m tests.benchmarks.drift_alarms [--captures 200] [--turn-deg 0.2] [--noise-px 0.2] [--photographs] [--json]``.
Every capture is another subject (a head of the model with the studio's hair and shirt) and another calibration error.
Each is asked twice: with a random camera turned by ``--turn-deg`` about a random axis across its view, and with none.
``share_named`` is of the first; ``false_alarm_captures`` are captures of the second in which any camera is named, and
``false_alarms`` says what was said of them; ``others_named`` are those of the first in which another camera is named
beside the turned one or in its place.

The silhouettes are the true ones, or with ``--photographs`` those that segmentation finds in the studio's
pictures (ten times as slow).
"""

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pipeline.eigenheads.model import load_model
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.camera_drift import find_drift
from pipeline.settings import Settings
from pipeline.silhouettes.segment import segment
from rig.geometry import RigidTransform, rotation_from_vector
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.sensor.preset import PRESET
from server.tasks.subjects import drawn_subject
from tests.support.silhouette_subjects import captures_of, disturbed


def turned(rig: Rig, name: str, turn_deg: float, rng: np.random.Generator) -> Rig:
    around = rng.uniform(0.0, 2.0 * np.pi)
    vector = np.radians(turn_deg) * np.array([np.cos(around), np.sin(around), 0.0])
    motion = RigidTransform(rotation_from_vector(vector), np.zeros(3))
    return Rig(tuple(replace(c, camera_from_world=motion @ c.camera_from_world) if c.name == name else c for c in rig))


def photographs_of(
    renderer: Renderer, rig: Rig, count: int, rng: np.random.Generator
) -> Iterator[dict[str, Silhouette]]:
    """Silhouettes that segmentation finds in pictures of ``count`` subjects, taken with the benchmark's preset."""
    model, settings = load_model(), Settings().segmentation
    for _ in range(count):
        taken = simulate(drawn_subject(model, rng), rig, PRESET, rng, renderer=renderer)
        yield dict(segment(taken.capture, rig, settings, report=lambda stage, fraction: None))


def run(
    captures: int, turn_deg: float, noise_px: float, *, photographs: bool = False, seed: int = 7
) -> dict[str, object]:
    rig, rng = default_layout(), np.random.default_rng(seed)
    named = others = 0
    missed: list[str] = []
    false: list[list[str]] = []
    source = photographs_of if photographs else captures_of
    with Renderer.create() as renderer:
        for seen in source(renderer, rig, captures, rng.spawn(1)[0]):
            believed = disturbed(rig, noise_px, rng)
            culprit = str(rng.choice(rig.names))
            found = {drift.camera for drift in find_drift(seen, turned(believed, culprit, turn_deg, rng))}
            named += culprit in found
            missed += [] if culprit in found else [culprit]
            others += bool(found - {culprit})
            if alarms := find_drift(seen, believed):
                false.append([str(alarm) for alarm in alarms])
    return {
        "captures": captures,
        "named": named,
        "share_named": round(named / max(1, captures), 4),
        "missed": missed,
        "others_named": others,
        "false_alarm_captures": len(false),
        "false_alarm_share": round(len(false) / max(1, captures), 4),
        "false_alarms": false,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Cameras named by the drift watch.")
    parser.add_argument("--captures", type=int, default=200)
    parser.add_argument("--turn-deg", type=float, default=0.2)
    parser.add_argument("--noise-px", type=float, default=0.2)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--photographs", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = run(
        options.captures, options.turn_deg, options.noise_px, photographs=options.photographs, seed=options.seed
    )
    sys.stdout.write(json.dumps(result, indent=None if options.json else 1) + "\n")


if __name__ == "__main__":
    main()

"""How much of the mean head's error the paper's simplex removes, in the model's span.

``python -m tests.laboratory.benchmarks.simplex_halves [--subjects 10] [--json]``: heads drawn from the first 60 eigenheads as
the simulated studio draws them, z ~ N(0, 1); eleven cameras, masks of the full mesh.
Error: mean over the face region's vertices, world frame, no realignment, mm. Three alignments: ``true``; ``features``,
section 4.2's from seven points picked with 1.5 px of noise in three views in front; ``refined``, the pose that the
contour solver finds from there. The simplex itself never moves the pose.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.alignment.landmarks import align_to_features
from pipeline.contour_fit.contour import fit_contour
from pipeline.head_model.landmarks import SEVEN_POINTS
from pipeline.head_model.model import HeadModel, load_model, with_modes
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.settings import Settings
from pipeline.simplex.hierarchy import fit_simplex
from rig.camera import Camera, Intrinsics
from rig.capture import Features
from rig.geometry import Similarity, look_at, rotation_from_vector
from rig.render.renderer import Renderer
from rig.rig import Rig

MODES = 60
PICK_NOISE_PX = 1.5
ALIGNMENTS = ("true", "features", "refined")
# azimuth, elevation (degrees): the front hemisphere, as in section 5.3 (a)
PLACES = [(0, 0), (0, 35), (0, -30), (-35, 15), (35, 15), (-35, -25), (35, -25), (-70, 5), (70, 5), (-90, 30), (90, 30)]


@dataclass(frozen=True, slots=True)
class Row:
    """One subject, one alignment: mm before and after, evaluations and seconds."""

    subject: int
    alignment: str
    mean_head_mm: float
    simplex_mm: float
    evaluations: int
    seconds: float


def bench_rig() -> Rig:
    """Eleven cameras of 1024 x 768 at 1.2 m."""
    intrinsics = Intrinsics(1024, 768, 2000.0, 2000.0, 511.5, 383.5)
    cameras = []
    for number, (azimuth, elevation) in enumerate(np.radians(PLACES)):
        direction = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        pose = look_at(1200.0 * np.array(direction), np.zeros(3), np.array([0.0, 1.0, 0.0]))
        cameras.append(Camera(f"cam{number:02}", intrinsics, pose))
    return Rig(tuple(cameras))


def pick_features(
    model: HeadModel,
    coefficients: Float[np.ndarray, " m"],
    world_from_head: Similarity,
    rig: Rig,
    rng: np.random.Generator,
) -> Features:
    """The seven landmarks where three cameras in front see them, with a person's noise."""
    vertices = world_from_head.apply(model.vertices(coefficients, "full"))
    seen = [rig[name] for name in ("cam00", "cam03", "cam04")]
    return {
        name: {
            camera.name: camera.project(vertices[[model.landmarks[name]]])[0] + PICK_NOISE_PX * rng.standard_normal(2)
            for camera in seen
        }
        for name in SEVEN_POINTS
    }


def face_error(
    model: HeadModel, fitted: Float[np.ndarray, " m"], aligned: Similarity, truth_world: Float[np.ndarray, "v 3"]
) -> float:
    face = model.levels["full"].face_region
    return float(np.linalg.norm(aligned.apply(model.vertices(fitted, "full"))[face] - truth_world[face], axis=1).mean())


def run_subject(model: HeadModel, number: int, renderer: Renderer) -> list[Row]:
    rng = np.random.default_rng(number)
    rig, settings = bench_rig(), Settings()
    truth = rng.standard_normal(MODES)
    pose = Similarity(1.0, rotation_from_vector(rng.normal(0, 0.1, 3)), rng.normal(0, 10.0, 3))
    vertices = pose.apply(model.vertices(truth, "full"))
    with renderer.silhouette_set(rig, model.levels["full"].faces) as drawn:
        silhouettes = {name: silhouette_from_mask(mask) for name, mask in drawn.masks(vertices).items()}
    features = pick_features(model, truth, pose, rig, rng)
    picked = align_to_features(model, features, rig, settings.alignment)
    contour = fit_contour(with_modes(model, MODES), picked, silhouettes, rig, settings.fitting, features=features)
    rows = []
    for kind, aligned in zip(ALIGNMENTS, (pose, picked, contour.world_from_head), strict=True):
        begun = time.perf_counter()
        fit = fit_simplex(
            model, aligned, silhouettes, rig, settings.fitting, renderer=renderer, report=lambda stage, fraction: None
        )
        seconds = time.perf_counter() - begun
        before = face_error(model, np.zeros(MODES), aligned, vertices)
        after = face_error(model, fit.coefficients, aligned, vertices)
        rows.append(Row(number, kind, before, after, fit.evaluations, seconds))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--subjects", type=int, default=10)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    model = load_model()
    rows: list[Row] = []
    with Renderer.create() as renderer:
        for number in range(options.subjects):
            for row in run_subject(model, number, renderer):
                rows.append(row)
                if not options.json:
                    sys.stdout.write(
                        f"{row.subject:3} {row.alignment:9} {row.mean_head_mm:6.2f} -> {row.simplex_mm:5.2f} mm"
                        f"  {row.evaluations} evaluations {row.seconds:5.1f} s\n"
                    )
                    sys.stdout.flush()
    figures = {}
    for kind in ALIGNMENTS:
        chosen = [row for row in rows if row.alignment == kind]
        before, after = (float(np.mean([getattr(r, key) for r in chosen])) for key in ("mean_head_mm", "simplex_mm"))
        figures |= {f"mean_head_mm_{kind}": before, f"simplex_mm_{kind}": after, f"share_left_{kind}": after / before}
    figures["ms_per_evaluation"] = 1000 * sum(r.seconds for r in rows) / sum(r.evaluations for r in rows)
    sys.stdout.write((json.dumps({"figures": figures}) if options.json else str(figures)) + "\n")


if __name__ == "__main__":
    main()

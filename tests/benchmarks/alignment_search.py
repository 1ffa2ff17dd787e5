"""How often the alignment is found without feature points: `python -m tests.benchmarks.alignment_search [--draws 200]`.

Heads of the model with hair and clothes from the simulated studio, turned by up to 30 degrees (yaw), 15 (pitch) and
15 (roll) and up to 60 mm off the rig's centre; the world frame of every draw is another. Right is within 2 degrees and
3 mm of the truth after the fit, by Procrustes of the face region against the true vertices.
"""

import argparse
import json
import sys
import time
from dataclasses import replace

import numpy as np

from pipeline.alignment_search import search_alignment
from pipeline.eigenheads.model import load_model, with_modes
from pipeline.fitting.contour import fit_contour
from pipeline.settings import Settings
from pipeline.silhouette import silhouette_from_mask
from rig.geometry import RigidTransform, Similarity, nearest_rotation, rotation_from_vector, vector_from_rotation
from rig.layout import Rig
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.layout import default_layout
from rig.studio.preset import PRESET
from rig.studio.simulate import build_scene
from rig.studio.subject import Subject

YAW_DEG, PITCH_DEG, ROLL_DEG, OFF_MM = 30.0, 15.0, 15.0, 60.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    model = load_model()
    span = with_modes(model, 60)
    right = 0
    with Renderer.create() as renderer:
        for seed in range(options.first, options.first + options.draws):
            angle, off, seconds = draw(model, span, seed, renderer)
            good = angle < 2.0 and off < 3.0
            right += int(good)
            text = f"draw {seed}: {angle:.2f} degrees, {off:.2f} mm, search {seconds:.2f} s{'' if good else '  WRONG'}"
            sys.stderr.write(text + "\n")
    figures = {"right_share": right / options.draws, "draws": options.draws}
    sys.stdout.write(json.dumps({"figures": figures}) + "\n")


def draw(model, span, seed: int, renderer: Renderer) -> tuple[float, float, float]:
    """Angle (degrees) and distance (mm) of the found head from the true one, and the seconds of the search."""
    rng = np.random.default_rng([77, seed])
    vertices = model.vertices(np.clip(rng.standard_normal(60), -2, 2))
    full = model.levels["full"]
    landmarks = {name: vertices[index] for name, index in model.landmarks.items()}
    rig = default_layout()
    yaw, pitch, roll = rng.uniform(-1, 1, 3) * np.radians([YAW_DEG, PITCH_DEG, ROLL_DEG])
    turn = [rotation_from_vector(a * np.eye(3)[i]) for i, a in ((1, yaw), (0, pitch), (2, roll))]
    direction = rng.standard_normal(3)
    offset = OFF_MM * rng.uniform() * direction / np.linalg.norm(direction)
    pose = Similarity(1.0, turn[0] @ turn[1] @ turn[2], rig.centre_world() + offset)
    subject = Subject(Mesh(vertices, full.faces), landmarks, full.face_region)
    scene = build_scene(subject, rig, replace(PRESET, samples=1), rng, renderer=renderer, world_from_head=pose)
    silhouettes = {name: silhouette_from_mask(view.mask) for name, view in scene.views.items()}
    other = RigidTransform(rotation_from_vector(rng.standard_normal(3)), 300.0 * rng.standard_normal(3))
    foreign = Rig(tuple(replace(c, camera_from_world=c.camera_from_world @ other.inverse()) for c in rig))
    began = time.perf_counter()
    start = search_alignment(span, silhouettes, foreign, Settings(), front="cam00", report=lambda stage, fraction: None)
    seconds = time.perf_counter() - began
    fit = fit_contour(span, start, silhouettes, foreign, Settings().fitting)
    region = full.face_region
    true = other.apply(pose.apply(vertices))[region]
    found = fit.world_from_head.apply(span.vertices(fit.coefficients))[region]
    a, b = true - true.mean(0), found - found.mean(0)
    angle = np.degrees(np.linalg.norm(vector_from_rotation(nearest_rotation(b.T @ a))))
    return float(angle), float(np.linalg.norm(true.mean(0) - found.mean(0))), seconds


if __name__ == "__main__":
    main()

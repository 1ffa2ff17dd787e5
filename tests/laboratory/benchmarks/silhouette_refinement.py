"""How close do silhouettes bring cameras back that are off by 0.5 px, do they leave exact ones alone, and what is that
worth to a head?

``python -m tests.laboratory.benchmarks.silhouette_refinement [--seeds 3] [--captures 5] [--error-px 0.5] [--heads 2] [--rims]
[--proposal] [--json]``. Every seed has its own subjects (heads of the model's first 60 modes with the studio's hair and
shirts) and its own camera errors. Distances are RMS over the cameras of ``calibration.adjustment.gauge.image_distance``
to the truth; ``no_scale_px`` leaves out the rig's scale, which no silhouette shows: eleven cameras that are off each
for itself are off in scale too, and what the start has of that stays. ``sigma_px`` is what the refined rig's
covariances say of the distance. ``--proposal``: only what all captures agree on, from disturbed cameras, with no
capture held out and nothing decided, at an eleventh of the time.

``head_..._mm``, before, after and exact: mean distance of the face's vertices from the truth, world
frame, of further subjects fitted without per-camera terms, with the cameras as disturbed, as refined, and exact. These
heads are bare, so that cameras are what limits them; ``hair_...`` are the same heads with hair and shirt, whose fits
hang on what the hair hides.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.adjustment.gauge import image_distance, image_metric, subject_points
from calibration.silhouette_refinement.refine import PRIOR_PX, minimise_tangencies, refine
from calibration.silhouette_refinement.rims import Heads
from pipeline.contour_fit.contour import fit_contour
from pipeline.head_model.model import HeadModel, load_model, with_modes
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.settings import FittingSettings
from rig.geometry import Similarity, rotation_from_vector
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.silhouette_subjects import captures_of, disturbed, dressed_head, rms

MODES = 60
START_DEG, START_MM = 2.0, 4.0  # of a fit
NO_CAMERA_TERMS_PX = 0.01  # as a prior: next to nothing moves


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """A subject with its truth: vertices of the bare head in the world (mm), and where a fit starts."""

    seen: dict[str, Silhouette]
    truth: Float[np.ndarray, "v 3"]
    start: Similarity


def heads_of(renderer: Renderer, rig: Rig, count: int, rng: np.random.Generator, *, bare: bool) -> list[Head]:
    model, heads = load_model(), []
    for head_rng in rng.spawn(count):
        vertices, faces, pose = dressed_head(model, rig, head_rng, MODES, bare=bare)
        with renderer.silhouette_set(rig, faces) as drawn:
            masks = drawn.masks(pose.apply(vertices))
        turn = rotation_from_vector(np.radians(START_DEG) * head_rng.standard_normal(3) / np.sqrt(3.0))
        shift = START_MM * head_rng.standard_normal(3) / np.sqrt(3.0)
        start = Similarity(1.0, turn @ pose.rotation, pose.translation + shift)
        seen = {name: silhouette_from_mask(mask) for name, mask in masks.items()}
        heads.append(Head(seen, pose.apply(vertices)[: model.levels["full"].count], start))
    return heads


def head_error_mm(heads: list[Head], rig: Rig, model: HeadModel) -> float:
    """Mean over the heads of the mean distance of the face's vertices."""
    face, misses = model.levels["full"].face_region, []
    for head in heads:
        fit = fit_contour(model, head.start, head.seen, rig, FittingSettings(calibration_px=NO_CAMERA_TERMS_PX))
        found = fit.world_from_head.apply(model.vertices(fit.coefficients))
        misses.append(np.linalg.norm(found - head.truth, axis=1)[face].mean())
    return float(np.mean(misses))


def stated_sigma_px(rig: Rig) -> float | None:
    """RMS over the cameras of the image motion at the subject that their covariances allow."""
    if any(camera.covariance is None for camera in rig):
        return None
    metrics = image_metric(rig, subject_points(rig))
    squares = [np.trace(metric @ camera.covariance) for metric, camera in zip(metrics, rig, strict=True)]
    return float(np.sqrt(np.mean(squares)))


def distances_px(name: str, rig: Rig, truth: Rig) -> dict[str, object]:
    """The distance of the module's docstring, with and without the scale."""
    found = {"px": image_distance(rig, truth), "no_scale_px": image_distance(rig, truth, scale=True)}
    return {f"{name}_{kind}": round(rms(values), 3) for kind, values in found.items()}


def run(
    renderer: Renderer, rig: Rig, seed: int, captures: int, error_px: float, heads: int, *, rims: bool, proposal: bool
) -> list[dict[str, object]]:
    """Figures from disturbed and from exact cameras."""
    rng = np.random.default_rng(seed)
    model = with_modes(load_model(), MODES)
    if rims:
        subjects = heads_of(renderer, rig, captures, rng, bare=False)
        seen, speaking = [head.seen for head in subjects], Heads(model, [head.start for head in subjects])
    else:
        seen, speaking = list(captures_of(renderer, rig, captures, rng)), None
    others = {
        kind: heads_of(renderer, rig, heads, np.random.default_rng((seed, 1)), bare=not kind) for kind in ("", "hair_")
    }
    rows = []
    off = disturbed(rig, error_px, rng)
    if proposal:
        found = minimise_tangencies(seen, off, focal=False, prior_px=PRIOR_PX, heads=speaking)
        return [{"seed": seed} | distances_px("start", off, rig) | distances_px("proposed", found, rig)]
    for start in (off, rig):
        began = time.perf_counter()
        found = refine(seen, start, heads=speaking)
        taken = time.perf_counter() - began
        row: dict[str, object] = {
            "seed": seed,
            **distances_px("start", start, rig),
            **distances_px("result", found.rig, rig),
            **distances_px("proposed", found.proposed, rig),
            "sigma_px": stated_sigma_px(found.proposed),
            "kept": found.kept,
            "held_out_px": [round(found.before_px, 3), round(found.after_px, 3)],
            "seconds": round(taken, 1),
        }
        if heads:
            rigs = {"before": start, "after": found.rig} if start is off else {"exact": rig}
            for name, chosen in rigs.items():
                for kind, subjects in others.items():
                    row[f"{kind}head_{name}_mm"] = round(head_error_mm(subjects, chosen, model), 3)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="Cameras brought back by silhouettes.")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--captures", type=int, default=5)
    parser.add_argument("--error-px", type=float, default=0.5)
    parser.add_argument("--heads", type=int, default=2)
    parser.add_argument("--rims", action="store_true", help="use the head model's rims as well")
    parser.add_argument("--proposal", action="store_true", help="hold no capture out, decide nothing")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with Renderer.create() as renderer:
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            for row in run(
                renderer,
                default_layout(),
                seed,
                options.captures,
                options.error_px,
                options.heads,
                rims=options.rims,
                proposal=options.proposal,
            ):
                text = json.dumps(row) if options.json else "  ".join(f"{k} {v}" for k, v in row.items())
                sys.stdout.write(text + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()

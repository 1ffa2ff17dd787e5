"""How close do silhouettes bring cameras back that are off by 0.5 px, do they leave exact ones alone, and what is that
worth to a head?

python -m tests.laboratory silhouette_refinement --seeds 8 --heads 2 --rims

Every seed has its own subjects (heads of the model's first 60 modes with the studio's hair and shirts) and its own
camera errors. Distances are RMS over the cameras of ``calibration.adjustment.gauge.image_distance`` to the truth;
``no_scale_px`` leaves out the rig's scale, which no silhouette shows: eleven cameras that are off each for itself are
off in scale too, and what the start has of that stays. ``sigma_px`` is what the refined rig's covariances say of the
distance. ``--proposal``: only what all captures agree on, from disturbed cameras, with no capture held out and nothing
decided, at an eleventh of the time.

``head_..._mm``, before, after and exact: mean distance of the face's vertices from the truth, world
frame, of further subjects fitted without per-camera terms, with the cameras as disturbed, as refined, and exact. These
heads are bare, so that cameras are what limits them; ``hair_...`` are the same heads with hair and shirt, whose fits
hang on what the hair hides.
"""

import time
from typing import Annotated, Any

import numpy as np

from calibration.adjustment.gauge import image_distance, image_metric, subject_points
from calibration.silhouette_refinement.refine import PRIOR_PX, minimise_tangencies, refine
from calibration.silhouette_refinement.rims import Heads
from pipeline.contour_fit.contour import fit_contour
from pipeline.head_model.model import HeadModel, load_model, with_modes
from pipeline.settings import FittingSettings
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.silhouette_subjects import MODES, Head, captures_of, disturbed, heads_of, rms

NO_CAMERA_TERMS_PX = 0.01  # as a prior: next to nothing moves


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
    renderer: Renderer,
    report: Progress,
    *,
    seeds: int = 3,
    first_seed: int = 0,
    captures: int = 5,
    error_px: float = 0.5,
    heads: int = 2,
    rims: Annotated[bool, "use the head model's rims as well"] = False,
    proposal: Annotated[bool, "hold no capture out, decide nothing"] = False,
) -> dict[str, Any]:
    """Returns the figures of each seed, from disturbed and from exact cameras."""
    found = {}
    for seed in range(first_seed, first_seed + seeds):
        report(f"seed {seed}", (seed - first_seed) / seeds)
        rows = refine_seed(renderer, seed, captures, error_px, heads, rims=rims, proposal=proposal)
        found |= {f"seed {seed}, {start}": row for start, row in zip(("disturbed", "exact"), rows, strict=False)}
    return {"figures": found}


def refine_seed(
    renderer: Renderer, seed: int, captures: int, error_px: float, heads: int, *, rims: bool, proposal: bool
) -> list[dict[str, object]]:
    """Figures from disturbed and from exact cameras."""
    rng, rig = np.random.default_rng(seed), default_layout()
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
        return [distances_px("start", off, rig) | distances_px("proposed", found, rig)]
    for start in (off, rig):
        began = time.perf_counter()
        found = refine(seen, start, heads=speaking)
        taken = time.perf_counter() - began
        row: dict[str, object] = {
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

"""Measures how closely a model can represent a real face: the lowest error of any result made with it.

A model is fitted directly to a true surface (face region), with free pose, fixed scale, prior N(0, I). The remaining
distance is its floor: no cameras and no solver can do better within its span. Truths are the subjects of rendered
captures (folders with head.ply, face_mask.npy, meta.json), and random heads of a second model.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.applications.model_building.sources.imports import fit_surface
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.landmarks import SEVEN_POINTS
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import vertex_areas
from rig.errors import InputError
from rig.formats.meshes.mesh_file import read_mesh
from rig.geometry import RigidTransform, rigid_fit
from rig.progress import Progress
from tests.laboratory.experiments.records import Outcome
from tests.support.model_draws import of_draws

SIGMA_MM = 1.5  # residual that weighs as much as one standard deviation of a coefficient, per cm² of face
POINTS = 4000  # points of the truth in a fit; all of them count in the figures


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Holds points of a true face with the areas they stand for (mm²), and its seven feature points."""

    name: str
    points: Float[np.ndarray, "N 3"]
    areas: Float[np.ndarray, " N"]
    features: Mapping[str, Float[np.ndarray, " 3"]]


def run(
    models: Mapping[str, HeadModel],
    truths: Sequence[Truth],
    *,
    counts: Sequence[int] = (60, 0),
    report: Progress | None = None,
) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``: floors of each model on each truth,
    for each count of modes (0: all).

    ``figures`` is flat: ``<model>_<modes>_<truth>_{median,mean}_mm`` and ``_largest_sigma`` for each single truth, and
    ``<model>_<modes>_draws_...`` as means over the truths whose names start with ``draw:``; besides these
    ``<model>_own_draws_{generalisation,specificity}_mm``, since a low floor alone is no merit.
    """
    rows = []
    jobs = [(name, truth, count) for name in models for truth in truths for count in counts]
    for k, (name, truth, count) in enumerate(jobs):
        rows.append(floor(name, models[name], truth, count))
        if report:
            report("fitting", (k + 1) / len(jobs))
    worths = {
        f"{name}_own_draws_{key}": round(value, 4) for name in models for key, value in of_draws(models[name]).items()
    }
    return {"figures": _figures(rows) | worths, "rows": rows}


def floor(name: str, model: HeadModel, truth: Truth, count: int = 0) -> dict:
    """Fits the first ``count`` modes of the model (0: all) to the true face, and returns one row of the table: median,
    mean and 95th percentile of the distances (mm, area-weighted), and the size of the coefficients in standard
    deviations. ``name``: the model's name in the row."""
    used = min(count or len(model.modes), len(model.modes))
    coefficients, place = best_likeness(model, truth, used)
    surface = SurfaceIndex(place.apply(model.vertices(coefficients)), model.levels["full"].faces)
    distances, z = surface.closest(truth.points).distances, np.abs(coefficients)
    return {
        "model": name,
        "truth": truth.name,
        "modes": "all" if count == 0 else count,
        "modes_used": used,
        "median_mm": weighted_quantile(distances, truth.areas, 0.5),
        "mean_mm": float(distances @ truth.areas / truth.areas.sum()),
        "p95_mm": weighted_quantile(distances, truth.areas, 0.95),
        "largest_sigma": float(z.max()),
        "beyond_3_sigma": int((z > 3).sum()),
        "rms_sigma": float(np.sqrt((z**2).mean())),
    }


def best_likeness(model: HeadModel, truth: Truth, count: int) -> tuple[Float[np.ndarray, " m"], RigidTransform]:
    """Fits the model to the truth's points, starting from the seven feature points. Returns coefficients and pose."""
    ours = model.vertices(np.zeros(0))
    source = np.array([ours[model.landmarks[name]] for name in truth.features])
    start = rigid_fit(source, np.array(list(truth.features.values())))
    some = np.random.default_rng(0).permutation(len(truth.points))[:POINTS]
    areas = truth.areas[some] * (truth.areas.sum() / truth.areas[some].sum())
    return fit_surface(model, truth.points[some], areas, start, count, sigma_mm=SIGMA_MM)


def weighted_quantile(values: Float[np.ndarray, " N"], weights: Float[np.ndarray, " N"], share: float) -> float:
    """Returns the value below which ``share`` of the weight lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][np.searchsorted(below, share).clip(0, len(values) - 1)])


def read_truth(folder: Path) -> Truth:
    """Reads a truth folder, as the simulator and the shared captures have it. Raises InputError."""
    missing = [f"{n} is missing" for n in ("head.ply", "face_mask.npy", "meta.json") if not (folder / n).is_file()]
    if missing:
        raise InputError(str(folder), missing)
    mesh = read_mesh(folder / "head.ply")
    mask = np.load(folder / "face_mask.npy")
    landmarks = json.loads((folder / "meta.json").read_text(encoding="utf-8"))["landmarks_world"]
    features = {name: np.asarray(landmarks[name], float) for name in SEVEN_POINTS if name in landmarks}
    return Truth(
        folder.name.removesuffix(".truth"), mesh.vertices[mask], vertex_areas(mesh.vertices, mesh.faces)[mask], features
    )


def random_draws(model: HeadModel, count: int, *, seed: int = 0) -> list[Truth]:
    """Returns faces of random heads of ``model``, all modes, z ~ N(0, I); named ``draw:0`` and following."""
    level = model.levels["full"]
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        vertices = model.vertices(rng.standard_normal(len(model.modes)))
        areas = vertex_areas(vertices, level.faces)[level.face_region]
        features = {name: vertices[model.landmarks[name]] for name in SEVEN_POINTS}
        out.append(Truth(f"draw:{k}", vertices[level.face_region], areas, features))
    return out


def _figures(rows: list[dict]) -> dict[str, float]:
    groups: dict[str, list[dict]] = {}
    for row in rows:
        truth = "draws" if row["truth"].startswith("draw:") else row["truth"]
        groups.setdefault(f"{row['model']}_{row['modes']}_{truth}", []).append(row)
    figures = {}
    for key, group in groups.items():
        for column in ("median_mm", "mean_mm", "p95_mm", "rms_sigma"):
            figures[f"{key}_{column}"] = round(float(np.mean([row[column] for row in group])), 4)
        figures[f"{key}_largest_sigma"] = round(max(row["largest_sigma"] for row in group), 3)
        figures[f"{key}_beyond_3_sigma"] = sum(row["beyond_3_sigma"] for row in group)
    return figures

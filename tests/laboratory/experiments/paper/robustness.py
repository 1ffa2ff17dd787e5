"""Measures how much the contour solver loses when its input is worse than it should be.

The base are heads without hair as in section 5.2, with exact cameras and binary masks. Every other condition has the
same heads and the same start, and its error is compared with the base's:

- one and three cameras missing, drawn anew for each head;
- hair over the ears, and hair with a fringe down the forehead, both with a shirt;
- a fifth of each contour wrong: disks of 6 to 18 px added or cut out along it;
- images of a half and a quarter of the size.

Calibration errors of 0.1, 0.2 and 0.5 px (a head moves by so much in each image) are compared with the joint bound: the
Cramer-Rao bound of shape, pose and cameras together for 0.3 px of Gaussian contour noise, when only the size of the
errors is known. They are stated as the cameras' covariance in one run; in the other they are not, and the solver
assumes its default of 0.2 px.

Two cameras swapped, and one camera turned by 1 and by 5 degrees: the subject has hair and a shirt, and the masks go
through ``reconstruct``'s own checks (agreement of the masks, drift). A fault counts as found if every bad camera is
left out by name. The error is that of the fit to the remaining cameras, compared with the same capture's without the
fault.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial

import numpy as np

from pipeline.head_model.model import HeadModel, with_modes
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.segmentation import segment as agreement
from pipeline.segmentation.segment import segment
from pipeline.settings import FittingSettings, Settings
from pipeline.view_checks import camera_drift as drift
from pipeline.view_checks.usable_views import exclude_moved_cameras
from rig.capture import Capture
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.hair import HairStyle
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper import limit
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.spoilt_captures import OVER_EARS, knocked, spoiled
from tests.support.subjects import (
    Planted,
    binary_silhouettes,
    exact,
    exact_silhouettes,
    face_errors,
    fit_contour,
    mean_error_mm,
    off_by,
    random_subjects,
    stated,
    worn_silhouettes,
)

FRINGE = HairStyle(thickness_mm=14.0, fringe_mm=16.0)
CALIBRATIONS_PX, CONTOUR_NOISE_PX = (0.1, 0.2, 0.5), 0.3
KNOCKS_DEG = (1.0, 5.0)


def robustness(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 20) -> Outcome:
    """Returns the contour solver's errors under each condition of this module, their ratios to those of perfect input
    and to the best possible error (the Cramer-Rao bound), and how often faulty cameras are found."""
    records = bench.records("robustness", key_of(model.sha256, Settings(), *CONTOUR, limit, agreement, drift))
    span = with_modes(model, 60)
    rows = []
    planted = random_subjects(subjects, seed=66)
    for i, subject in enumerate(planted):
        row: Row = {"name": subject.name}
        for j, (name, condition) in enumerate(CONDITIONS.items()):
            rng = np.random.default_rng([66, i, j])
            compute = partial(condition, span, subject, renderer, rng)
            row[name] = records.row(f"{subject.name} {name}", compute, (i + j / len(CONDITIONS)) / subjects)
        rows.append(row)
    found = figures(rows)
    return {"figures": found, "rows": rows, "markdown": as_markdown(found)}


Condition = Callable[[HeadModel, Planted, Renderer, np.random.Generator], Row]


def fitted(model: HeadModel, subject: Planted, silhouettes: Mapping[str, Silhouette], rig: Rig) -> Row:
    """Fits the contours, and returns the mean distance (mm) of the face region's vertices from their true positions."""
    fit = fit_contour(model, subject.start, silhouettes, rig, FittingSettings())
    return {"error_mm": mean_error_mm(model, fit, subject)}


def resolution(scale: float, model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator) -> Row:
    """Fits a subject to silhouettes drawn at ``scale`` times the usual resolution."""
    rig = exact(default_layout())
    return fitted(model, subject, binary_silhouettes(model, subject, rig, renderer, scale), rig.scaled(scale))


def missing(count: int, model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator) -> Row:
    """Fits a subject without ``count`` of the cameras, drawn at random."""
    rig = exact(default_layout())
    lost = sorted(rng.choice(rig.names, count, replace=False).tolist())
    rest = rig.subset(name for name in rig.names if name not in lost)
    return fitted(model, subject, binary_silhouettes(model, subject, rest, renderer), rest) | {"lost": lost}


def worn(style: HairStyle, model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator) -> Row:
    """Fits a subject whose silhouettes contain hair of a style."""
    rig = exact(default_layout())
    return fitted(model, subject, worn_silhouettes(model, subject, rig, renderer, style, rng), rig)


def wrong_contours(model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator) -> Row:
    """Fits a subject to silhouettes with parts of their contours spoiled."""
    rig = exact(default_layout())
    clean = binary_silhouettes(model, subject, rig, renderer)
    return fitted(model, subject, {n: silhouette_from_mask(spoiled(s.mask, rng)) for n, s in clean.items()}, rig)


def calibration(
    error_px: float, known: bool, model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator
) -> Row:
    """Fits a subject with cameras that stand elsewhere than the rig says, by ``error_px`` in the image. ``known``: the
    rig states that error as covariance. Returns the root mean square error and the joint Cramer-Rao bound, mm."""
    rig, clean = default_layout(), _clean(model, subject, renderer)
    believed = off_by(stated(rig, error_px) if known else rig, error_px, rng)
    noisy = {n: limit.with_noise(s, CONTOUR_NOISE_PX, limit.CORRELATION_PX, rng) for n, s in clean.items()}
    fit = fit_contour(model, subject.start, noisy, believed, limit.settings_for(CONTOUR_NOISE_PX))
    errors = face_errors(model, fit, subject)
    return {
        "error_mm": float(np.linalg.norm(errors, axis=1).mean()),
        "rmse_mm": float(np.sqrt((errors**2).sum(axis=1).mean())),
        "bound_mm": limit.bound_mm(model, subject, clean, stated(rig, error_px), CONTOUR_NOISE_PX),
    }


@lru_cache(maxsize=1)
def _clean(model: HeadModel, subject: Planted, renderer: Renderer) -> dict[str, Silhouette]:
    """Sub-pixel outlines of one subject take ten seconds and serve six conditions."""
    return exact_silhouettes(model, subject, default_layout(), renderer)


def faulty(kind: str, model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator) -> Row:
    """Fits a subject with a fault of the cameras. Returns which cameras ``reconstruct`` leaves out, and the remaining
    error; the kind ``none`` shows false alarms."""
    rig = default_layout()
    first, second = rng.choice(rig.names, 2, replace=False).tolist()
    true, bad = rig, []
    if kind.startswith("knocked"):
        true, bad = knocked(rig, first, float(kind.removeprefix("knocked_").removesuffix("deg")), rng), [first]
    masks = {n: s.mask for n, s in worn_silhouettes(model, subject, true, renderer, OVER_EARS, rng).items()}
    if kind == "swapped":
        masks[first], masks[second] = masks[second], masks[first]
        bad = sorted([first, second])
    silhouettes = segment(Capture({}, {}, masks, {}), rig, report=lambda stage, fraction: None)
    silhouettes, _ = exclude_moved_cameras(silhouettes, rig)
    left_out = sorted(name for name, silhouette in silhouettes.items() if not silhouette.quality.usable)
    row = fitted(model, subject, silhouettes, rig)
    return row | {"bad": bad, "left_out": left_out, "found": set(bad) <= set(left_out)}


CONDITIONS: dict[str, Condition] = {
    "base": partial(resolution, 1.0),
    "one_missing": partial(missing, 1),
    "three_missing": partial(missing, 3),
    "hair_over_ears": partial(worn, OVER_EARS),
    "hair_on_forehead": partial(worn, FRINGE),
    "contour_wrong": wrong_contours,
    "half_resolution": partial(resolution, 0.5),
    "quarter_resolution": partial(resolution, 0.25),
    **{f"stated_{px}px": partial(calibration, px, True) for px in CALIBRATIONS_PX},
    **{f"unstated_{px}px": partial(calibration, px, False) for px in CALIBRATIONS_PX},
    "no_fault": partial(faulty, "none"),
    "swapped": partial(faulty, "swapped"),
    **{f"knocked_{turn:g}deg": partial(faulty, f"knocked_{turn:g}deg") for turn in KNOCKS_DEG},
}
FAULTS = ("no_fault", "swapped", *(f"knocked_{turn:g}deg" for turn in KNOCKS_DEG))


def figures(rows: list[Row]) -> dict[str, float]:
    """Returns, for each condition, the mean and the largest error (mm), their ratio to the undisturbed case and, where
    they apply, the ratio to the Cramér-Rao bound and the shares of faults that were found and of good cameras that were
    left out."""
    found: dict[str, float] = {"subjects": len(rows)}
    for name in CONDITIONS:
        errors = np.array([row[name]["error_mm"] for row in rows])
        base = np.array([row["no_fault" if name in FAULTS else "base"]["error_mm"] for row in rows])
        found[f"{name}_mm"], found[f"{name}_worst_mm"] = float(errors.mean()), float(errors.max())
        found[f"{name}_ratio"] = float(errors.mean() / base.mean())
        if "bound_mm" in rows[0][name]:
            rmse, bound = (np.array([row[name][q] for row in rows]) for q in ("rmse_mm", "bound_mm"))
            found[f"{name}_over_bound"] = float(np.sqrt((rmse**2).mean() / (bound**2).mean()))
        if name in FAULTS:
            found[f"{name}_found"] = float(np.mean([row[name]["found"] for row in rows]))
            extra = [set(row[name]["left_out"]) - set(row[name]["bad"]) for row in rows]
            found[f"{name}_others_left_out"] = float(np.mean([len(names) for names in extra]))
    return found


def as_markdown(found: Mapping[str, float]) -> str:
    """Returns the figures as a Markdown table with a row for each condition."""
    columns = ("mm", "worst_mm", "ratio", "over_bound", "found", "others_left_out")
    rows = [[name, *(found.get(f"{name}_{column}") for column in columns)] for name in CONDITIONS]
    header = ("condition", "error, mm", "worst", "times the base", "RMSE / bound", "found", "good cameras left out")
    return markdown.table(header, rows)

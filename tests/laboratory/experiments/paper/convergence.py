"""Measures how often the contour solver converges to the right head, from the mean head at a start as feature points
leave it.

Heads are drawn as in section 5.2, without hair, with exact cameras and binary masks. A fit is right if its mean error
over the face is below 0.3 mm. A second set of heads is drawn from the model, z ~ N(0, I), whose start is twice as far
off.
"""

import numpy as np

from pipeline.head_model.model import HeadModel, with_modes
from pipeline.settings import FittingSettings
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.subjects import Planted, binary_silhouettes, exact, fit_contour, mean_error_mm, random_subjects

ARRIVED_MM = 0.3
KINDS = {"section52": 0.8, "normal": None}  # coefficients within this, or not bounded
SHARES = {"section52": 1.0, "normal": 0.2}  # of the draws


def convergence(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 500) -> Outcome:
    """Runs this module's experiment. Returns, for both sets of heads, the share that converges and the errors."""
    records = bench.records("convergence", key_of(model.sha256, FittingSettings(), *CONTOUR))
    span, rig = with_modes(model, 60), exact(default_layout())
    jobs: list[tuple[str, Planted]] = []
    for kind, most in KINDS.items():
        count = max(1, round(SHARES[kind] * subjects))
        jobs += [(kind, subject) for subject in random_subjects(count, seed=500, most=most)]
    rows = []
    for i, (kind, subject) in enumerate(jobs):
        row = records.row(f"{kind} {subject.name}", lambda s=subject: _row(span, s, rig, renderer), i / len(jobs))
        rows.append({"kind": kind, "name": subject.name} | row)
    figures, table = {}, []
    for kind in KINDS:
        errors = np.array([row["error_mm"] for row in rows if row["kind"] == kind])
        found = {
            "draws": len(errors),
            "arrived": float((errors < ARRIVED_MM).mean()),
            "mean_mm": float(errors.mean()),
            "median_mm": float(np.median(errors)),
            "p99_mm": float(np.quantile(errors, 0.99)),
            "largest_mm": float(errors.max()),
        }
        figures |= {f"{kind}_{name}": value for name, value in found.items()}
        table.append([kind, *found.values()])
    header = ("heads", "draws", "arrived", "mean, mm", "median", "99 %", "largest")
    return {"figures": figures, "rows": rows, "markdown": markdown.table(header, table)}


def _row(model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer) -> Row:
    silhouettes = binary_silhouettes(model, subject, rig, renderer)
    fit = fit_contour(model, subject.start, silhouettes, rig, FittingSettings())
    return {"error_mm": mean_error_mm(model, fit, subject), "evaluations": fit.evaluations}

"""Compares the paper's eqs. (4) and (5) as costs for subjects with hair, with both solvers.

The simplex minimises each as written (every pixel of the image counts), and eq. (5) with only the face's outline, as
this project uses it. For a contour the difference is this: eq. (5) hardly penalises what lies far from the input's
contour, eq. (4) does. So the contour solver runs with its robust scale, and with one so wide that no outlier loses
weight. The simplex has the true alignment. Errors are over the face, mm.
"""

from dataclasses import replace
from typing import Literal, TypedDict

import numpy as np

from pipeline.contour_fit.fit import Fit
from pipeline.head_model.model import HeadModel, with_modes
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from pipeline.simplex import hierarchy as schedule
from pipeline.simplex import nelder_mead as simplex
from pipeline.simplex import xor_objective as objective
from pipeline.simplex.hierarchy import fit_simplex
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.hair import HairStyle
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.subjects import Planted, exact, fit_contour, mean_error_mm, random_subjects, worn_silhouettes


class SimplexCost(TypedDict):
    """Holds which pixels count, and whether they are weighted by eq. (5) or counted by eq. (4)."""

    speaking: Literal["face", "all"]
    weighted: bool


STYLE = HairStyle(thickness_mm=16.0, over_ears=True, fringe_mm=8.0)
UNFORGIVING_PX = 1e3
SIMPLEX: dict[str, SimplexCost] = {
    "simplex_eq4": {"speaking": "all", "weighted": False},
    "simplex_eq5": {"speaking": "all", "weighted": True},
    "simplex_eq5_face": {"speaking": "face", "weighted": True},
}
FORGIVING = {"contour_unforgiving": replace(FittingSettings(), robust_px=UNFORGIVING_PX), "contour": FittingSettings()}


def cost(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 3) -> Outcome:
    """Runs this module's experiment. Returns the errors by solver and cost, and those of the mean head."""
    sources = (*CONTOUR, objective, schedule, simplex)
    records = bench.records("cost", key_of(model.sha256, FittingSettings(), STYLE, *sources))
    span, rig = with_modes(model, 60), exact(default_layout())
    rows = []
    for i, subject in enumerate(random_subjects(subjects, seed=44)):
        silhouettes = worn_silhouettes(span, subject, rig, renderer, STYLE, np.random.default_rng([44, i]))
        mean_head = Fit("", np.zeros(60), subject.world_from_head, 0, "")
        row: Row = {"name": subject.name, "mean_head": mean_error_mm(span, mean_head, subject)}
        for name in (*FORGIVING, *SIMPLEX):
            bench.report(f"{subject.name} {name}", i / subjects)
            kept = records.row(
                f"{subject.name} {name}",
                lambda n=name, s=subject, seen=silhouettes: {"error_mm": _error(n, span, s, seen, rig, renderer)},
            )
            row[name] = kept["error_mm"]
        rows.append(row)
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0] if name != "name"}
    return {
        "figures": {"subjects": len(rows)} | {f"{name}_mm": value for name, value in means.items()},
        "rows": rows,
        "markdown": markdown.table(("solver and cost", "error, mm"), list(means.items())),
    }


def _error(
    name: str, model: HeadModel, subject: Planted, silhouettes: dict[str, Silhouette], rig: Rig, renderer: Renderer
) -> float:
    if name in FORGIVING:
        return mean_error_mm(model, fit_contour(model, subject.start, silhouettes, rig, FORGIVING[name]), subject)
    fit = fit_simplex(
        model, subject.world_from_head, silhouettes, rig, FittingSettings(), renderer=renderer,
        report=lambda stage, fraction: None, **SIMPLEX[name],
    )  # fmt: skip
    return mean_error_mm(model, fit, subject)

"""Measures what the hierarchy of section 5.1 saves: time and error of full images and meshes, and of the levels 95/50
and 99/75 (mesh decimated by so many percent, image reduced by so many), each alone and with the coarse result as its
start.

The simplex has the true alignment. Its full level takes minutes for each subject, so that only the first
``FULL_SUBJECTS`` get it. For comparison, the contour solver runs on images of full, half and a quarter of the size; it
has levels of its own.
"""

import time

import numpy as np

from pipeline.head_model.model import HeadModel, with_modes
from pipeline.settings import FittingSettings
from pipeline.simplex import hierarchy as schedule
from pipeline.simplex import nelder_mead as simplex
from pipeline.simplex import xor_objective as objective
from pipeline.simplex.hierarchy import HierarchyLevel, fit_simplex
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.subjects import Planted, binary_silhouettes, exact, fit_contour, mean_error_mm, random_subjects

FULL, MIDDLE, COARSE = HierarchyLevel("full", 1.0), HierarchyLevel("p95", 0.5), HierarchyLevel("p99", 0.25)
HIERARCHIES = {
    "99/75": (COARSE,),
    "95/50": (MIDDLE,),
    "95/50 after 99/75": (COARSE, MIDDLE),
    "full after 99/75": (COARSE, FULL),
    "full": (FULL,),
}
FULL_SUBJECTS = 1
SCALES = {"full images": 1.0, "half images": 0.5, "quarter images": 0.25}


def levels(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 3) -> Outcome:
    """Runs this module's experiment. Returns seconds, evaluations and errors by hierarchy."""
    sources = (*CONTOUR, objective, schedule, simplex)
    records = bench.records("levels", key_of(model.sha256, FittingSettings(), *sources))
    span, rig = with_modes(model, 60), exact(default_layout())
    rows = []
    for i, subject in enumerate(random_subjects(subjects, seed=55)):
        for name, scale in SCALES.items():
            bench.report(f"{subject.name} contour, {name}", i / subjects)
            row = records.row(f"{subject.name} {name}", lambda s=subject, x=scale: _contour(span, s, rig, x, renderer))
            rows.append({"solver": "contour", "levels": name} | row)
        for name, hierarchy in HIERARCHIES.items():
            if FULL in hierarchy and i >= FULL_SUBJECTS:
                continue
            bench.report(f"{subject.name} simplex, {name}", i / subjects)
            row = records.row(
                f"{subject.name} {name}", lambda s=subject, h=hierarchy: _simplex(span, s, rig, h, renderer)
            )
            rows.append({"solver": "simplex", "levels": name} | row)
    figures, table = {}, []
    for solver, name in dict.fromkeys((row["solver"], row["levels"]) for row in rows):
        of = [row for row in rows if (row["solver"], row["levels"]) == (solver, name)]
        means = {q: float(np.mean([row[q] for row in of])) for q in ("seconds", "evaluations", "error_mm")}
        key = f"{solver}_{name.replace('/', '_').replace(' ', '_')}"
        figures |= {f"{key}_{quantity}": value for quantity, value in means.items()}
        table.append([solver, name, len(of), *means.values()])
    header = ("solver", "levels", "subjects", "seconds", "evaluations", "error, mm")
    return {"figures": figures, "rows": rows, "markdown": markdown.table(header, table)}


def _contour(model: HeadModel, subject: Planted, rig: Rig, scale: float, renderer: Renderer) -> Row:
    silhouettes = binary_silhouettes(model, subject, rig, renderer, scale)
    fit_contour(model, subject.start, silhouettes, rig.scaled(scale), FittingSettings())  # warm
    began = time.perf_counter()
    fit = fit_contour(model, subject.start, silhouettes, rig.scaled(scale), FittingSettings())
    seconds = time.perf_counter() - began
    return {"seconds": seconds, "evaluations": fit.evaluations, "error_mm": mean_error_mm(model, fit, subject)}


def _simplex(
    model: HeadModel, subject: Planted, rig: Rig, hierarchy: tuple[HierarchyLevel, ...], renderer: Renderer
) -> Row:
    silhouettes = binary_silhouettes(model, subject, rig, renderer)
    began = time.perf_counter()
    fit = fit_simplex(
        model, subject.world_from_head, silhouettes, rig, FittingSettings(), renderer=renderer,
        report=lambda stage, fraction: None, hierarchy=hierarchy,
    )  # fmt: skip
    seconds = time.perf_counter() - began
    return {"seconds": seconds, "evaluations": fit.evaluations, "error_mm": mean_error_mm(model, fit, subject)}

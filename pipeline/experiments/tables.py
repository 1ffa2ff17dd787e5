"""Tables 1 to 3 of the paper: accuracy over 100 subjects, correlations, arrangements of eleven cameras.

XOR: pixels that differ at full mesh and image resolution, all cameras together (eq. 4). L2: root of the sum of squared
distances of corresponding vertices of the whole mesh, in mm. Hausdorff: largest distance from a vertex of one mesh to
the nearest of the other, both ways, in mm. The paper does not state its units; its database is another.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from pipeline.eigenheads.model import HeadModel, with_modes
from pipeline.experiments.records import Records, Row
from pipeline.experiments.subjects import Planted, binary_silhouettes, exact, subjects_of_section_5_2
from pipeline.fitting.contour import fit_contour
from pipeline.fitting.fit import Fit
from pipeline.fitting.schedule import fit_simplex
from pipeline.settings import FittingSettings
from pipeline.silhouette import xor_cost
from rig.layout import Rig
from rig.render.renderer import Renderer
from rig.studio.layout import arrangement, default_layout

Report = Callable[[str, float], None]
STATISTICS = {"min": np.min, "max": np.max, "mean": np.mean, "median": np.median, "std": np.std}
ARRANGEMENTS = ("a", "b", "c", "d")


def table1(
    model: HeadModel,
    *,
    renderer: Renderer,
    report: Report,
    subjects: int = 100,
    simplex_subjects: int | None = None,
    folder: Path | None = None,
) -> dict[str, Any]:
    """Tables 1 and 2. ``simplex_subjects``: how many of them the simplex fits too (all, if None)."""
    rows = _rows(model, default_layout(), "table1", subjects, simplex_subjects, renderer, report, folder)
    figures: dict[str, float] = {"subjects": len(rows)}
    for method in ("contour", "simplex"):
        done = [row[method] for row in rows if method in row]
        for quantity in ("xor", "l2", "hausdorff", "mean_error_mm") if done else ():
            values = np.array([row[quantity] for row in done])
            for name, statistic in STATISTICS.items():
                figures[f"{method}_{quantity}_{name}"] = float(statistic(values))
            for kind in ("database", "random"):
                of = [row[method][quantity] for row in rows if method in row and row["name"].startswith(kind)]
                if of:
                    figures[f"{method}_{quantity}_{kind}_mean"] = float(np.mean(of))
        if done:
            figures[f"{method}_mean_error_mm"] = figures.pop(f"{method}_mean_error_mm_mean")
            for pair in (("xor", "l2"), ("xor", "hausdorff"), ("l2", "hausdorff")):
                figures[f"{method}_{pair[0]}_{pair[1]}_correlation"] = correlation(done, *pair)
    figures["start_mean_error_mm"] = float(np.mean([row["start"]["mean_error_mm"] for row in rows]))
    figures["floor_mean_error_mm"] = float(np.mean([row["floor_mm"] for row in rows]))
    if "contour_xor_l2_correlation" in figures:
        # Over starts and results of both solvers: within the results of a solver that is nearly exact nothing is left
        # to correlate.
        every = [row[kind] for row in rows for kind in ("start", "contour", "simplex") if kind in row]
        for pair in (("xor", "l2"), ("xor", "hausdorff"), ("l2", "hausdorff")):
            figures[f"{pair[0]}_{pair[1]}_correlation"] = correlation(every, *pair)
    return {"figures": figures, "rows": rows}


def table3(
    model: HeadModel,
    *,
    renderer: Renderer,
    report: Report,
    subjects: int = 100,
    simplex_subjects: int | None = 25,
    folder: Path | None = None,
) -> dict[str, Any]:
    """The four arrangements of section 5.3."""
    figures, rows = {}, {}
    for name in ARRANGEMENTS:
        rig = arrangement(name)
        rows[name] = _rows(model, rig, f"table3-{name}", subjects, simplex_subjects, renderer, report, folder)
        for method in ("contour", "simplex"):
            done = [row[method] for row in rows[name] if method in row]
            if done:
                for quantity in ("xor", "l2", "mean_error_mm"):
                    figures[f"{name}_{method}_{quantity}"] = float(np.mean([row[quantity] for row in done]))
                figures[f"{name}_{method}_xor_l2_correlation"] = correlation(done, "xor", "l2")
    return {"figures": figures, "rows": rows}


def correlation(rows: list[Row], one: str, two: str) -> float:
    values = np.array([[row[one], row[two]] for row in rows])
    return float(np.corrcoef(values.T)[0, 1]) if len(values) > 2 else float("nan")


def _rows(
    model: HeadModel,
    rig: Rig,
    name: str,
    subjects: int,
    simplex_subjects: int | None,
    renderer: Renderer,
    report: Report,
    folder: Path | None,
) -> list[Row]:
    records = Records(folder, name, f"{model.sha256} {FittingSettings()}")
    rows = []
    everyone = subjects_of_section_5_2(model, subjects)
    slow = len(everyone) if simplex_subjects is None else simplex_subjects
    with_simplex = (
        {everyone[i].name for i in np.linspace(0, len(everyone) - 1, slow).round().astype(int)} if slow else set()
    )
    for i, subject in enumerate(everyone):
        report(name, i / len(everyone))
        row = records.row(subject.name, lambda s=subject: _contour_row(model, s, exact(rig), renderer))
        if subject.name in with_simplex:
            simplex = records.row(
                subject.name + " simplex", lambda s=subject: _simplex_row(model, s, exact(rig), renderer)
            )
            row = row | {"simplex": simplex}
        rows.append(row)
    return rows


def _contour_row(model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer) -> Row:
    span = with_modes(model, 60)
    silhouettes = binary_silhouettes(model, subject, rig, renderer)
    fit = fit_contour(span, subject.start, silhouettes, rig, FittingSettings())
    mean = replace(fit, coefficients=np.zeros(60), world_from_head=subject.start)
    best = replace(fit, coefficients=subject.coefficients[:60], world_from_head=subject.world_from_head)
    return {
        "name": subject.name,
        "start": scores(model, mean, subject, rig, renderer),
        "contour": scores(model, fit, subject, rig, renderer),
        "floor_mm": scores(model, best, subject, rig, renderer)["mean_error_mm"],
    }


def _simplex_row(model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer) -> Row:
    """The paper's solver does not move the head, so it is given the true alignment."""
    silhouettes = binary_silhouettes(model, subject, rig, renderer)
    fit = fit_simplex(
        with_modes(model, 60), subject.world_from_head, silhouettes, rig, FittingSettings(),
        renderer=renderer, report=lambda stage, fraction: None,
    )  # fmt: skip
    return scores(model, fit, subject, rig, renderer)


def scores(model: HeadModel, fit: Fit, subject: Planted, rig: Rig, renderer: Renderer) -> Row:
    """XOR, L2, Hausdorff and mean face error of a fit."""
    found = fit.world_from_head.apply(model.vertices(fit.coefficients))
    true = subject.vertices(model)
    with renderer.silhouette_set(rig, model.levels["full"].faces) as drawn:
        ours, theirs = drawn.masks(found), drawn.masks(true)
    distance = np.linalg.norm(found - true, axis=1)
    apart = [KDTree(b).query(a, workers=2)[0].max() for a, b in ((found, true), (true, found))]
    return {
        "xor": sum(xor_cost(theirs[name], ours[name]) for name in ours),
        "l2": float(np.sqrt((distance**2).sum())),
        "hausdorff": float(max(apart)),
        "mean_error_mm": float(distance[model.levels["full"].face_region].mean()),
        "evaluations": fit.evaluations,
    }

"""Repeats tables 1 to 3 of the paper: accuracy over 100 subjects, correlations, arrangements of eleven cameras.

XOR: pixels that differ at full mesh and image resolution, all cameras together (eq. 4). L2: root of the sum of squared
distances of corresponding vertices of the whole mesh, mm. Hausdorff: largest distance from a vertex of one mesh to the
nearest of the other, both ways, mm. The paper does not state its units; its database is another.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np
from scipy.spatial import KDTree

from pipeline.contour_fit.fit import Fit
from pipeline.head_model.model import HeadModel, with_modes
from pipeline.settings import FittingSettings
from pipeline.simplex import hierarchy as schedule
from pipeline.simplex import nelder_mead
from pipeline.simplex import xor_objective as objective
from pipeline.simplex.hierarchy import fit_simplex
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments import markdown, pictures
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.layouts import arrangement
from tests.support.subjects import Planted, binary_silhouettes, exact, fit_contour, subjects_of_section_5_2

STATISTICS = {"min": np.min, "max": np.max, "mean": np.mean, "median": np.median, "std": np.std}
METHODS = {  # as rows name them: as tables do
    "contour": "contour",
    "contour_all": "contour, all modes",  # in whose span the database's subjects are, as the paper's were
    "simplex": "simplex",
}
ARRANGEMENTS = ("a", "b", "c", "d")
PAIRS = (("xor", "l2"), ("xor", "hausdorff"), ("l2", "hausdorff"))
PAPER = {  # min, max, mean, median, std; other database, other units
    "XOR, paper": (1509, 4104, 2579, 2527, 600.8),
    "L2, paper": (12.59, 115.3, 45.44, 39.90, 20.40),
    "Hausdorff, paper": (0.297, 2.826, 0.762, 0.676, 0.424),
}
PAPER_CORRELATIONS = (0.89, 0.70, 0.79)
PICTURED = 3  # subjects in the figures
PICTURED_CAMERAS = ("cam00", "cam03", "cam08")


def table1(
    model: HeadModel,
    *,
    renderer: Renderer,
    bench: Bench,
    subjects: int = 100,
    simplex: Annotated[int, "how many the simplex fits too"] = 100,
) -> Outcome:
    """Returns tables 1 and 2 and pictures like figures 4 and 5. ``simplex``: how many the simplex fits too."""
    rows = _rows(model, default_layout(), "table1", subjects, simplex, renderer=renderer, bench=bench, all_too=True)
    figures: dict[str, float] = {"subjects": len(rows), "simplex_subjects": sum("simplex" in row for row in rows)}
    for method in METHODS:
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
    figures["start_mean_error_mm"] = float(np.mean([row["start"]["mean_error_mm"] for row in rows]))
    for kind in ("database", "random"):
        of = [row for row in rows if row["name"].startswith(kind)]
        if of:
            figures[f"floor_{kind}_mm"] = float(np.mean([row["floor_mm"] for row in of]))
    correlations = _correlations(rows)
    found = figures | correlations
    return {
        "figures": found,
        "rows": rows,
        "markdown": _table1_markdown(found) + "\n" + _table2_markdown(correlations),
        "pictures": _pictures(model, default_layout(), rows, renderer),
    }


def table2(
    model: HeadModel,
    *,
    renderer: Renderer,
    bench: Bench,
    subjects: int = 100,
    simplex: Annotated[int, "how many the simplex fits too"] = 100,
) -> Outcome:
    """Returns table 2 alone, from table 1's rows."""
    rows = _rows(model, default_layout(), "table1", subjects, simplex, renderer=renderer, bench=bench, all_too=True)
    figures = _correlations(rows)
    return {"figures": {"subjects": len(rows)} | figures, "rows": rows, "markdown": _table2_markdown(figures)}


def table3(
    model: HeadModel,
    *,
    renderer: Renderer,
    bench: Bench,
    subjects: int = 100,
    simplex: Annotated[int, "how many the simplex fits too"] = 25,
) -> Outcome:
    """Computes table 3: the accuracy with the four arrangements of cameras of section 5.3."""
    figures, rows, table = {}, {}, []
    for name in ARRANGEMENTS:
        rig = arrangement(name)
        rows[name] = _rows(model, rig, f"table3-{name}", subjects, simplex, renderer=renderer, bench=bench)
        for method in ("contour", "simplex"):
            done = [row[method] for row in rows[name] if method in row]
            if done:
                means = {q: float(np.mean([row[q] for row in done])) for q in ("xor", "l2", "mean_error_mm")}
                related = correlation(done, "xor", "l2")
                table.append([f"({name})", method, len(done), *means.values(), related])
                means |= {} if related is None else {"xor_l2_correlation": related}
                figures |= {f"{name}_{method}_{quantity}": value for quantity, value in means.items()}
    header = ("arrangement", "solver", "subjects", "mean XOR", "mean L2, mm", "mean error, mm", "correlation XOR-L2")
    return {"figures": figures, "rows": rows, "markdown": markdown.table(header, table)}


def correlation(rows: list[Row], one: str, two: str) -> float | None:
    """Returns Pearson's correlation of two quantities over the rows; None for fewer than three rows."""
    values = np.array([[row[one], row[two]] for row in rows])
    return float(np.corrcoef(values.T)[0, 1]) if len(values) > 2 else None


def _correlations(rows: list[Row]) -> dict[str, float]:
    """Of each solver's results, and (``xor_l2_correlation`` ...) over starts and results of both: within the results of
    a solver that is nearly exact there is nothing left to correlate."""
    of = {f"{method}_": [row[method] for row in rows if method in row] for method in METHODS}
    of[""] = [row[kind] for row in rows for kind in ("start", "contour", "simplex") if kind in row]
    found = {f"{kind}{a}_{b}_correlation": correlation(done, a, b) for kind, done in of.items() for a, b in PAIRS}
    return {name: value for name, value in found.items() if value is not None}


def _table1_markdown(found: Mapping[str, float]) -> str:
    rows: list[list[markdown.Cell]] = []
    for quantity, title in (("xor", "XOR, px"), ("l2", "L2, mm"), ("hausdorff", "Hausdorff, mm")):
        for method, words in METHODS.items():
            if f"{method}_{quantity}_min" in found:
                rows.append([f"{title}, {words}", *(found[f"{method}_{quantity}_{name}"] for name in STATISTICS)])
        paper = next(name for name in PAPER if name.startswith(title.split(",")[0]))
        rows.append([paper, *PAPER[paper]])
    for method, words in METHODS.items():
        if f"{method}_mean_error_mm" in found:
            spread = {name: found.get(f"{method}_mean_error_mm_{name}") for name in STATISTICS}
            spread["mean"] = found[f"{method}_mean_error_mm"]
            rows.append([f"mean error of the face, mm, {words}", *spread.values()])
    return markdown.table(("", *STATISTICS), rows)


def _table2_markdown(found: Mapping[str, float]) -> str:
    names = ["_".join(pair) + "_correlation" for pair in PAIRS]
    rows: list[list[markdown.Cell]] = [
        [words, *(found.get(f"{method}_{name}") for name in names)] for method, words in METHODS.items()
    ]
    rows.append(["starts and results of both", *(found.get(name) for name in names)])
    rows.append(["paper", *PAPER_CORRELATIONS])
    return markdown.table(("correlation", "XOR-L2", "XOR-Hausdorff", "L2-Hausdorff"), rows)


def _rows(
    model: HeadModel,
    rig: Rig,
    name: str,
    subjects: int,
    simplex: int,
    *,
    renderer: Renderer,
    bench: Bench,
    all_too: bool = False,
) -> list[Row]:
    """One row a subject; the solvers' rows are kept apart, so that a change of one does not cost the other's.
    ``all_too``: the contour solver with every mode of the model as well."""
    key = (model.sha256, FittingSettings())
    ours = bench.records(name, key_of(*key, *CONTOUR))
    wide = bench.records(f"{name}-all", key_of(*key, *CONTOUR))
    theirs = bench.records(f"{name}-simplex", key_of(*key, objective, schedule, nelder_mead))
    everyone, rig = subjects_of_section_5_2(model, 100), exact(rig)
    chosen = [everyone[i] for i in _evenly(len(everyone), subjects)]
    slow = {chosen[i].name for i in _evenly(len(chosen), min(simplex, len(chosen)))}
    rows = []
    for i, subject in enumerate(chosen):
        bench.report(f"{name} {subject.name}", i / len(chosen))
        row = ours.row(subject.name, partial(_contour_row, model, subject, rig, renderer))
        if all_too:
            row = row | {"contour_all": wide.row(subject.name, partial(_all_row, model, subject, rig, renderer))}
        if subject.name in slow:
            row = row | {"simplex": theirs.row(subject.name, partial(_simplex_row, model, subject, rig, renderer))}
        rows.append(row)
    return rows


def _evenly(total: int, count: int) -> list[int]:
    """``count`` of ``total`` indices, half of them in each half."""
    return np.linspace(0, total - 1, count).round().astype(int).tolist()


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


def _all_row(model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer) -> Row:
    silhouettes = binary_silhouettes(model, subject, rig, renderer)
    fit = fit_contour(model, subject.start, silhouettes, rig, FittingSettings())
    return scores(model, fit, subject, rig, renderer)


def _simplex_row(model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer) -> Row:
    """The paper's solver does not move the head, so it is given the true alignment."""
    silhouettes = binary_silhouettes(model, subject, rig, renderer)
    fit = fit_simplex(
        with_modes(model, 60), subject.world_from_head, silhouettes, rig, FittingSettings(),
        renderer=renderer, report=lambda stage, fraction: None,
    )  # fmt: skip
    return scores(model, fit, subject, rig, renderer)


def scores(model: HeadModel, fit: Fit, subject: Planted, rig: Rig, renderer: Renderer) -> Row:
    """Returns XOR, L2, Hausdorff and mean face error of a fit, and the fit itself."""
    found = fit.world_from_head.apply(model.vertices(fit.coefficients))
    true = subject.vertices(model)
    with renderer.silhouette_set(rig, model.levels["full"].faces) as drawn:
        ours, theirs = drawn.masks(found), drawn.masks(true)
    distance = np.linalg.norm(found - true, axis=1)
    apart = [KDTree(b).query(a, workers=2)[0].max() for a, b in ((found, true), (true, found))]
    pose = fit.world_from_head
    return {
        "xor": float(sum(np.count_nonzero(theirs[name] ^ ours[name]) for name in ours)),
        "l2": float(np.sqrt((distance**2).sum())),
        "hausdorff": float(max(apart)),
        "mean_error_mm": float(distance[model.levels["full"].face_region].mean()),
        "evaluations": fit.evaluations,
        "coefficients": fit.coefficients.tolist(),
        "pose": [pose.scale, pose.rotation.tolist(), pose.translation.tolist()],
    }


def _pictures(model: HeadModel, rig: Rig, rows: list[Row], renderer: Renderer) -> dict[str, pictures.ImageRgb]:
    """Figure 4: true head and fits; figure 5: what differs before and after the fit."""
    planted = {subject.name: subject for subject in subjects_of_section_5_2(model, 100)}
    with_both = [row for row in rows if "simplex" in row] or rows
    shown = [with_both[i] for i in _evenly(len(with_both), min(PICTURED, len(with_both)))]
    faces = model.levels["full"].faces
    panels, before_after = [], []
    with renderer.silhouette_set(rig, faces) as drawn:
        for row in shown:
            subject = planted[row["name"]]
            panels.append([(f"{subject.name}: true", Mesh(model.vertices(subject.coefficients), faces))])
            seen = drawn.masks(subject.vertices(model))
            for kind in ("start", "contour", "simplex"):
                if kind not in row:
                    continue
                vertices, error = model.vertices(np.array(row[kind]["coefficients"])), row[kind]["mean_error_mm"]
                panels[-1].append((f"{kind}: {error:.2f} mm", Mesh(vertices, faces)))
                before_after.append((f"{subject.name} {kind}", seen, drawn.masks(_pose(row[kind]).apply(vertices))))
    width = max(len(panel) for panel in panels)
    panels = [panel for panel in panels if len(panel) == width]
    cameras = [name for name in PICTURED_CAMERAS if name in rig]
    return {"figure4": pictures.heads(panels), "figure5": pictures.differences(before_after, cameras)}


def _pose(row: Row) -> Similarity:
    scale, rotation, translation = row["pose"]
    return Similarity(scale, np.array(rotation), np.array(translation))

"""Measures heads with an expression and the same heads without: the delivered surface, and the expression that is
reported.

Heads of a model's own population (all modes) in the simulated studio are photographed with a random expression and
neutral. Distances are as in ``detail`` (from the true face to the delivered surface, by area). ``vertex`` is how far a
vertex of the face is from its true position, sliding along the surface included.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from pipeline.contour_fit import expression_evidence
from pipeline.detail import expression_reading
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments.paper.detail import Known, surface_error
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.drawn_expressions import drawn_weights

SEED = 22


def expressions(models: Mapping[str, HeadModel], *, renderer: Renderer, bench: Bench, subjects: int = 4) -> Outcome:
    """Runs this module's experiment. Returns distances by model: ``<model>_posed_median_mm`` and so on.

    Of the expression weights there are the correlation with the true ones (``<model>_weights_correlation_true`` over
    those that are not 0; ``..._all`` over all that are not 0 or reported for any head), the mean error of the true ones
    (``<model>_weights_off``), and the sum of weights reported for expressions that
    a head does not have (``<model>_weights_told_of_none``).
    """
    code = (*CONTOUR, expression_evidence, expression_reading)
    kept = {
        label: bench.records(f"expressions-{label}", key_of(model.sha256, Settings(), *code))
        for label, model in models.items()
    }
    rows: list[Row] = []
    for i, kind, (label, model) in product(range(subjects), ("posed", "neutral"), models.items()):
        bench.report(f"{label} {i} {kind}", (len(rows) + 1) / (2 * subjects * len(models)))
        row = kept[label].row(f"{label}-{i:02} {kind}", partial(_subject, model, i, kind == "posed", renderer))
        rows.append({"model": label, "kind": kind, "subject": i} | row)
    return {"figures": _figures(rows, tuple(models)), "rows": rows}


def _subject(model: HeadModel, number: int, posed: bool, renderer: Renderer) -> Row:
    rng = np.random.default_rng((SEED, number))
    coefficients = rng.standard_normal(len(model.modes))
    weights = drawn_weights(rng, model.expressions.names) if posed else {}
    head, full = model.posed_vertices(coefficients, weights), model.levels["full"]
    marks = {name: head[row] for name, row in model.landmarks.items()}
    sitter = Subject(Mesh(head, full.faces), marks, full.face_region, f"seed-{number}")
    shot = simulate(sitter, default_layout(), PRESET, np.random.default_rng((SEED, number, 1)), renderer=renderer)
    return {"truth": weights, **_delivered(model, shot, renderer)}


def _delivered(model: HeadModel, shot: SimulatedCapture, renderer: Renderer) -> Row:
    settings = replace(Settings(), outputs=OutputSettings(surface="head"))
    found = reconstruct(ReconstructionContext(shot.capture, shot.rig, model, settings, renderer))
    face, scene = model.levels["full"].face_region, shot.scene
    known = Known(scene.name, shot.capture, shot.rig, scene.head, face, scene.visible)
    apart = np.linalg.norm(found.mesh_world.vertices - scene.head.vertices, axis=1)[face]
    return {
        **surface_error(known, found.mesh_world),
        "vertex_mm": float(np.median(apart)),
        "fit_s": found.seconds["fit"],
        "weights": {each.name: each.weight for each in found.evidence.expression},
    }


def _figures(rows: list[Row], labels: tuple[str, ...]) -> dict[str, float]:
    found: dict[str, float] = {}
    for label in labels:
        for kind in ("posed", "neutral"):
            of = [row for row in rows if (row["model"], row["kind"]) == (label, kind)]
            for quantity in ("median_mm", "mean_mm", "p95_mm", "vertex_mm", "fit_s"):
                found[f"{label}_{kind}_{quantity}"] = float(np.mean([row[quantity] for row in of]))
            found[f"{label}_{kind}_weights"] = float(np.mean([sum(row["weights"].values()) for row in of]))
        found |= {f"{label}_{name}": value for name, value in _weights(rows, label).items()}
    return {name: round(value, 4) for name, value in found.items()}


def _weights(rows: list[Row], label: str) -> dict[str, float]:
    """Correlation over the true weights and over all that were drawn or told in any head; how far off the true ones
    are told. A weight that is not told is 0."""
    posed = [row for row in rows if (row["model"], row["kind"]) == (label, "posed")]
    names = sorted({name for row in posed for name in (*row["truth"], *row["weights"])})
    true = np.array([[row["truth"].get(name, 0.0) for name in names] for row in posed])
    estimated = np.array([[row["weights"].get(name, 0.0) for name in names] for row in posed])
    there = true > 0.0
    if np.count_nonzero(there) < 2:
        return {}
    return {
        "weights_correlation_true": float(np.corrcoef(true[there], estimated[there])[0, 1]),
        "weights_correlation_all": float(np.corrcoef(true.ravel(), estimated.ravel())[0, 1]),
        "weights_off": float(np.abs(estimated - true)[there].mean()),
        "weights_told_of_none": float(estimated[~there].sum() / len(posed)),
    }

"""Measures what a take knows of a person beyond single jobs: heads of each model's population, photographed in the
simulated studio with random expressions, one look and a new pose each moment.

Each moment is fitted to its photographs alone, and then all together. The neutral head (the shape without expression
weights) is aligned rigidly to the true one over the face; ``mean_mm`` and ``rms_mm`` are distances along the true
normals there, ``vertex_mm`` is the mean distance of corresponding vertices. ``single`` is the mean over the moments'
own neutral heads, ``mean`` the error of the mean of these heads, ``joint`` that of the take. Correlations of the
weights with the true ones are over those that are not 0 (``true``), over all (``all``), and over the first without eyes
(``skin``): these heads have no eyeballs, and a gaze moves their lids by a millimetre.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.applications.moments import arrow, joint_fit
from pipeline.applications.moments.joint_fit import fit_jointly
from pipeline.applications.moments.take import measure_difference, solution_of
from pipeline.contour_fit.contour import ContourSolution
from pipeline.contour_fit.expression_evidence import LIDS
from pipeline.head_model.model import HeadModel
from pipeline.photometric_fit import depth_search, refine
from pipeline.reconstruct import start_reconstruction
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.mesh import Mesh, vertex_normals
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject, random_look
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.moments.live import live as watch_live
from tests.laboratory.experiments.moments.sequences import sequences
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.drawn_expressions import drawn_weights

SEED = 54
SUBJECTS, MOMENTS = 5, 8
THREE = ("cam00", "cam03", "cam04")  # from the front, and 35 degrees to both sides above it
QUANTITIES = ("mean_mm", "rms_mm", "vertex_mm")
Points = Float[np.ndarray, "n 3"]


def moments(
    models: Mapping[str, HeadModel],
    *,
    renderer: Renderer,
    bench: Bench,
    subjects: int = SUBJECTS,
    moments: int = MOMENTS,
    cameras: Sequence[int] = (3, 11),
    sequence: int = 0,
    live: bool = False,
    folder: Path | None,
    scratch: Path,
) -> Outcome:
    """Runs this module's experiment. Returns figures named ``<cameras>_<who>_<quantity>``, ``<cameras>_gain`` (1 minus
    the joint error by the single one) and ``<cameras>_weights_...``, over all subjects of both models.

    ``subjects``: of each model. ``moments``: of each subject. ``cameras``: how many there are. ``sequence``: frames of
    a film, which is measured instead (``sequences``); films are kept in the folder of ``--out``. ``live``: the live
    head is measured instead (``live``).
    """
    if sequence:
        return sequences(models["default"], renderer, bench, folder or scratch, sequence)
    if live:
        return watch_live(models["default"], renderer, bench, scratch)
    settings = replace(Settings(), detail="photo", outputs=OutputSettings(surface="head"))
    code = (*CONTOUR, arrow, joint_fit, refine, depth_search)
    rows: list[Row] = []
    cases = [*product(range(subjects), models.items(), cameras)]
    for done, (number, (label, model), count) in enumerate(cases):
        name = f"{label}-{number:02} {count} cameras {moments} moments"
        records = bench.records(f"moments-{label}", key_of(model.sha256, settings, *code))
        row = records.row(name, partial(take_row, model, number, count, moments, settings, renderer), done / len(cases))
        skin = [not LIDS.match(each) for each in model.expressions.names]
        rows.append({"name": name, "model": label, "cameras": count, "skin": skin} | row)
    return {"figures": figures(rows), "rows": rows, "markdown": table(rows), "lines": table(rows).splitlines()}


def rig_of(count: int) -> Rig:
    """Returns the default rig, or three of its cameras."""
    return default_layout().subset(THREE) if count == len(THREE) else default_layout()


def take_row(model: HeadModel, number: int, cameras: int, count: int, settings: Settings, renderer: Renderer) -> Row:
    """Photographs one person and returns the errors of single fits and of the take."""
    rng = np.random.default_rng((SEED, number))
    identity, look = rng.standard_normal(len(model.modes)), random_look(rng)
    fitted, drawn = [], []
    for k in range(count):
        rng = np.random.default_rng((SEED, number, k))
        drawn.append(drawn_weights(rng, model.expressions.names))
        head, full = model.posed_vertices(identity, drawn[-1]), model.levels["full"]
        marks = {name: head[row] for name, row in model.landmarks.items()}
        sitter = Subject(Mesh(head, full.faces), marks, full.face_region, f"{number}-{k}")
        shot = simulate(sitter, rig_of(cameras), PRESET, rng, renderer=renderer, look=look)
        context = ReconstructionContext(replace(shot.capture, features={}), shot.rig, model, settings, renderer)
        fitted.append(next(start_reconstruction(context)))
    alone = [solution_of(head) for head in fitted]
    joint = fit_jointly(alone, settings.fitting.modes)
    truth, heads = model.vertices(identity), [neutral_head(each) for each in alone]
    singles = [neutral_error(model, head, truth) for head in heads]
    found = {
        "single": {name: np.mean([each[name] for each in singles]) for name in QUANTITIES},
        "mean": neutral_error(model, np.mean(heads, axis=0), truth),
        "joint": neutral_error(model, neutral_head(joint[0]), truth),
    }
    row: Row = {f"{who}_{name}": float(value) for who, of in found.items() for name, value in of.items()}
    row["apart"] = [
        measure_difference(head.fit, other, settings.fitting.modes) for head, other in zip(fitted, joint, strict=True)
    ]
    row["weights"] = {
        "true": [[each.get(name, 0.0) for name in model.expressions.names] for each in drawn],
        "single": [weights_of(each).tolist() for each in alone],
        "joint": [weights_of(each).tolist() for each in joint],
    }
    return row


def weights_of(solved: ContourSolution) -> Float[np.ndarray, " e"]:
    """Returns the expression weights of a solution, rounded."""
    posed = solved.problem.model.posed
    return solved.state.coefficients[posed.start : posed.stop].round(4)


def neutral_head(solved: ContourSolution) -> Points:
    """Returns the head of a solution without its expression: full level, head frame, mm."""
    coefficients, posed = solved.state.coefficients.copy(), solved.problem.model.posed
    coefficients[posed.start : posed.stop] = 0.0
    return solved.state.world_from_head.scale * solved.problem.model.vertices(coefficients)


def neutral_error(model: HeadModel, head: Points, truth: Points) -> dict[str, float]:
    """Returns the ``QUANTITIES`` of a neutral head after a rigid alignment over the face."""
    full = model.levels["full"]
    face, normals = full.face_region, vertex_normals(truth, full.faces)[full.face_region]
    at, to = head[face] - head[face].mean(axis=0), truth[face] - truth[face].mean(axis=0)
    left, _, right = np.linalg.svd(at.T @ to)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    off = at @ turn - to
    along = (off * normals).sum(axis=1)
    return {
        "mean_mm": float(np.abs(along).mean()),
        "rms_mm": float(np.sqrt((along**2).mean())),
        "vertex_mm": float(np.linalg.norm(off, axis=1).mean()),
    }


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Returns the means over rows by the number of cameras, gains, and correlations."""
    found: dict[str, float] = {}
    for count in sorted({row["cameras"] for row in rows}):
        of = [row for row in rows if row["cameras"] == count]
        for who, name in product(("single", "mean", "joint"), QUANTITIES):
            found[f"{count}_{who}_{name}"] = float(np.mean([row[f"{who}_{name}"] for row in of]))
        found[f"{count}_gain"] = 1.0 - found[f"{count}_joint_mean_mm"] / found[f"{count}_single_mean_mm"]
        found[f"{count}_apart_most"] = max(max(row["apart"]) for row in of)
        for who in ("single", "joint"):
            true, weights = (np.concatenate([np.ravel(row["weights"][part]) for row in of]) for part in ("true", who))
            skin = np.concatenate([np.tile(row["skin"], len(row["weights"]["true"])) for row in of])
            for name, over in (("true", true > 0), ("all", true >= 0), ("skin", (true > 0) & skin)):
                found[f"{count}_weights_{who}_{name}"] = float(np.corrcoef(true[over], weights[over])[0, 1])
    return {name: round(value, 4) for name, value in found.items()}


def table(rows: Sequence[Row]) -> str:
    """Returns a Markdown table: a line for each take, and one for the mean of each number of cameras."""
    header = ("take", "single mm", "mean of heads", "joint", "gain", "weights true, all, skin: single", "joint")
    lines = [[row["name"], *_cells(figures([row]), row["cameras"])] for row in rows]
    whole = figures(rows)
    for count in sorted({row["cameras"] for row in rows}):
        lines.append([f"all, {count} cameras", *_cells(whole, count)])
    return markdown.table(header, lines)


def _cells(of: Mapping[str, float], count: int) -> list[str]:
    errors = [f"{of[f'{count}_{who}_mean_mm']:.3f}" for who in ("single", "mean", "joint")]
    kinds = [[f"{count}_weights_{who}_{name}" for name in ("true", "all", "skin")] for who in ("single", "joint")]
    weights = [" ".join(f"{of[name]:.2f}" for name in names) for names in kinds]
    return [*errors, f"{of[f'{count}_gain']:.0%}", *weights]

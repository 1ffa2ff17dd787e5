"""Measures how captures of living people end: with a right pose, with a warning, or wrong without one.

Whole jobs run on captures with a truth and on heads in the studio, with rigs of many kinds, and with plates, true masks
or neither. A row has the rigid motion between the delivered face and the true one, the distances of the visible true
face to the delivered surface, the standard deviation that the file states for them, and the warnings. A result that is
wrong by its pose or by its own stated deviation, without a warning about plausibility, is *silently wrong*: their
number must be 0.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.landmarks import SEVEN_POINTS
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import vertex_areas
from pipeline.reconstruct import reconstruct
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.capture import Capture
from rig.errors import EigenheadError, InputError
from rig.render.renderer import Renderer
from rig.rig import Rig
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper.span import weighted_quantile
from tests.laboratory.experiments.people import eye_states, people_subjects, pose_error, view_subsets
from tests.laboratory.experiments.people.people_subjects import EVIDENCE, Case, Person, capture_cases, studio_cases
from tests.laboratory.experiments.people.pose_error import PoseError, pose_error_of_surfaces, pose_error_of_vertices
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of

EYES = "eyes"
SPEAKING = ("contour-implausible", "face-elsewhere", "no-face", "pose-doubtful", "scale-implausible")
"""Warnings that say of a result, not of its input, that it may be wrong."""
MAX_TURN_DEG, MAX_SHIFT_MM, MAX_DEVIATIONS = 3.0, 5.0, 3.0  # of a result that needs no warning
REFUSAL_LETTERS = 120  # of a refusal's sentence, in a row


def people(
    model: HeadModel,
    others: HeadModel | None,
    captures: Sequence[Path],
    *,
    renderer: Renderer,
    bench: Bench,
    subjects: int | None = None,
    only: Annotated[Sequence[str], "kinds, subjects or evidence; or eyes; may be repeated"] = (),
    detail: Literal["span", "kernel", "photo", "fine"] | None = None,
) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``; ``figures`` is flat,
    ``<kind>_<evidence>_<quantity>`` and ``<quantity>`` over all rows, with ``eyes_wrong`` among them if eyes are
    requested.

    ``model``: fitted; heads are drawn from it, too. ``others``: another population to draw from, if there is one.
    ``captures``: folders with a truth beside them. ``renderer``: for the studio. ``subjects``: heads in the studio for
    every kind (1 by default); for eyes, heads of each model (10 by default). ``only``: kinds, subjects or evidence to
    run. A row must match one word of each sort that is given. ``eyes`` runs the eyes alone. ``detail``: level of
    detail, None for the default.
    """
    settings = replace(Settings(), detail=detail, outputs=OutputSettings(surface="head"))
    key = key_of(model.sha256, settings, people_subjects, pose_error, view_subsets, eye_states)
    if set(only) == {EYES}:
        models = {"default": model} if others is None else {"default": model, "ict": others}
        run = partial(run_job, model=model, settings=settings, renderer=renderer)
        heads = subjects or eye_states.HEADS
        return eye_states.eyes(models, run, renderer=renderer, bench=bench, key=key, heads=heads)
    every = [case for path in captures for case in capture_cases(path)]
    every += studio_cases(model, others, renderer, subjects or 1)
    cases = select_cases(every, only)
    records = bench.records(f"people-{detail or 'default'}", key)
    rows: list[Row] = []
    for done, case in enumerate(cases):
        rows.append(
            {"name": case.name, "subject": case.subject, "kind": case.kind, "evidence": case.evidence}
            | records.row(case.name, partial(judge_case, case, model, settings, renderer), done / len(cases))
        )
    text = table(rows)
    return {"figures": figures(rows), "rows": rows, "markdown": text, "lines": text.splitlines()}


def select_cases(cases: Sequence[Case], only: Sequence[str]) -> list[Case]:
    """Returns the cases that match ``only``, as in ``people``. Raises InputError for a word that matches none."""
    sorts = [tuple(dict.fromkeys(values)) for values in zip(*(_labels(case) for case in cases), strict=True)]
    unknown = [word for word in only if not any(word in sort for sort in sorts)]
    if unknown:
        there = ", ".join(word for sort in reversed(sorts) for word in sort)
        raise InputError("--only", [f"{word} is none of {there} or {EYES}" for word in unknown])
    wanted = [set(only) & set(sort) for sort in sorts]
    return [
        case
        for case in cases
        if all(not words or label in words for words, label in zip(wanted, _labels(case), strict=True))
    ]


def _labels(case: Case) -> tuple[str, str, str]:
    return case.subject, case.kind, case.evidence


def judge_case(case: Case, model: HeadModel, settings: Settings, renderer: Renderer) -> Row:
    """Runs one job and judges it. A refusal or a crash is a finding, too, and noted in the row."""
    person, began = case.read(), time.perf_counter()
    try:
        result = run_job(person.capture, person.rig, model, settings, renderer)
    except EigenheadError as error:
        return {"refused": str(error)[:REFUSAL_LETTERS], "seconds": time.perf_counter() - began}
    except Exception as error:  # whatever the product does, the other rows are computed
        crash = f"{type(error).__name__}: {error}"
        return {"crashed": crash[:REFUSAL_LETTERS], "seconds": time.perf_counter() - began}
    seconds = time.perf_counter() - began
    return judge_result(person, result, model) | {"seconds": seconds}


def run_job(capture: Capture, rig: Rig, model: HeadModel, settings: Settings, renderer: Renderer) -> Reconstruction:
    """Runs a whole job, as the product does."""
    return reconstruct(ReconstructionContext(capture, rig, model, settings, renderer))


def judge_result(person: Person, result: Reconstruction, model: HeadModel) -> Row:
    """Computes the figures of a delivered head."""
    pose, fit = face_pose_error(person, result, model), result.head.fit
    assert fit.covariance is not None
    face = model.levels["full"].face_region
    row: Row = {
        "turn_deg": pose.turn_deg,
        "shift_mm": pose.shift_mm,
        "turn_stated_deg": float(np.degrees(np.sqrt(np.diag(fit.covariance)[-7:-4].max()))),
        "deviation_mm": float(np.median(result.refined.deviation_mm[face])),
        "level": result.refined.detail.level,
        "warnings": sorted({warning.code for warning in result.warnings}),
    }
    return row | face_error(person, result)


def face_pose_error(person: Person, result: Reconstruction, model: HeadModel) -> PoseError:
    """Computes the motion between the delivered face and the true one."""
    vertices, face = result.mesh_world.vertices, model.levels["full"].face_region
    truth = person.mesh_world
    if person.vertices_correspond:
        return pose_error_of_vertices(vertices[face], truth.vertices[face])
    marks = {name: vertices[model.landmarks[name]] for name in SEVEN_POINTS if name in model.landmarks}
    surface = SurfaceIndex(truth.vertices, truth.faces, 2.0)
    return pose_error_of_surfaces(vertices[face], marks, surface, person.landmarks_world)


def face_error(person: Person, result: Reconstruction) -> Row:
    """Computes the distances (mm, by area) of the visible true face to the delivered surface, and their ratios to the
    stated deviation there; empty if no two cameras see the face."""
    if not person.seen.any():
        return {}
    mesh = result.mesh_world
    hit = SurfaceIndex(mesh.vertices, mesh.faces, 1.0).closest(person.mesh_world.vertices[person.seen])
    areas = vertex_areas(person.mesh_world.vertices, person.mesh_world.faces)[person.seen]
    stated = (result.refined.deviation_mm[mesh.faces[hit.triangles]] * hit.weights).sum(axis=1)
    by_stated = hit.distances / np.maximum(stated, 1e-6)
    return {
        "face_median_mm": weighted_quantile(hit.distances, areas, 0.5),
        "face_p90_mm": weighted_quantile(hit.distances, areas, 0.9),
        "deviations_off": weighted_quantile(by_stated, areas, 0.5),
        "cover_95": float(areas[by_stated < 1.96].sum() / areas.sum()),
    }


def is_wrong(row: Row) -> bool:
    """Tells whether a delivered head should have a warning: its pose is wrong, or its errors are larger than it
    states."""
    off = row["turn_deg"] > MAX_TURN_DEG or row["shift_mm"] > MAX_SHIFT_MM
    return bool(off or row.get("deviations_off", 0.0) > MAX_DEVIATIONS)


def is_warned(row: Row) -> bool:
    """Tells whether a warning says that the result may be wrong."""
    return bool(set(row["warnings"]) & set(SPEAKING))


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Computes the summary of every kind with each evidence, of every evidence, and of all rows."""
    found = summary("", rows)
    for evidence in EVIDENCE:
        found |= summary(f"{evidence}_", [row for row in rows if row["evidence"] == evidence])
    for kind, evidence in dict.fromkeys((row["kind"], row["evidence"]) for row in rows):
        those = [row for row in rows if (row["kind"], row["evidence"]) == (kind, evidence)]
        found |= summary(f"{kind}_{evidence}_", those)
    return found


def summary(prefix: str, rows: Sequence[Row]) -> dict[str, float]:
    """Computes counts, the share without a warning, and the worst case of these, with medians over the delivered heads.
    Figures that no head has are left out."""
    if not rows:
        return {}
    delivered = [row for row in rows if "turn_deg" in row]
    silent = [row for row in delivered if not is_warned(row)]
    found: dict[str, float] = {
        "rows": len(rows),
        "refused": sum("refused" in row for row in rows),
        "crashed": sum("crashed" in row for row in rows),
        "silent_wrong": sum(is_wrong(row) for row in silent),
    }
    if delivered:
        found["unwarned_share"] = len(silent) / len(delivered)
        for key in ("turn_deg", "shift_mm", "face_median_mm", "face_p90_mm", "deviation_mm", "cover_95"):
            values = [row[key] for row in delivered if key in row]
            found |= {key: float(np.median(values))} if values else {}
    if silent:
        for key in ("turn_deg", "shift_mm", "deviations_off"):
            found[f"worst_unwarned_{key}"] = max(row.get(key, 0.0) for row in silent)
    return {f"{prefix}{key}": round(float(value), 4) for key, value in found.items()}


def table(rows: Sequence[Row]) -> str:
    """Returns a Markdown table with a row for each case; ``!`` marks results that are silently wrong."""
    header = (
        *("rig", "evidence", "subject", "turn, deg", "shift, mm", "face median, mm", "p90", "stated, mm"),
        *("off, stated", "in 95 %", "told", "s"),
    )
    order = sorted(rows, key=lambda row: (*_by_count(row["kind"]), EVIDENCE.index(row["evidence"]), row["subject"]))
    return markdown.table(header, [_cells(row) for row in order])


def _cells(row: Row) -> list[markdown.Cell]:
    keys = ("turn_deg", "shift_mm", "face_median_mm", "face_p90_mm", "deviation_mm", "deviations_off", "cover_95")
    ended = [f"{how}: {row[how]}" for how in ("refused", "crashed") if how in row]
    outcome = ended[0] if ended else ", ".join(row["warnings"]) or "-"
    mark = "! " if not ended and is_wrong(row) and not is_warned(row) else ""
    return [row["kind"], row["evidence"], mark + row["subject"], *(row.get(k) for k in keys), outcome, row["seconds"]]


def _by_count(kind: str) -> tuple[str, int]:
    shape, _, count = kind.partition("-")
    return {"front": "a", "circle": "b"}.get(shape, shape), int(count)

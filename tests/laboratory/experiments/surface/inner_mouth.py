"""Counts skin that meets teeth and tongue of a mesh (``pipeline.applications.templates.inner_mouth``).

The mesh is ICT-FaceKit's own head, whose lips part, with the model's true shapes, on heads of its population. Triangles
of the skin that meet teeth or tongue are counted at rest and for each of Apple's shapes at half and at full weight, as
the shapes come and once lips are kept off the teeth.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.applications.templates import inner_mouth as tested
from pipeline.applications.templates.inner_mouth import (
    TONGUE_OUT,
    WEIGHTS,
    InnerMouth,
    jaw_weight,
    keep_off_teeth,
    meeting_triangles,
    place_inner_mouth,
)
from pipeline.applications.templates.pivots import jaw_motions
from pipeline.head_model.model import HeadModel
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.surface.eyeballs import HEADS, OpenHead, open_head

Moves = Mapping[str, Float[np.ndarray, "v 3"]]


def inner_mouths(facekit: HeadModel, *, bench: Bench) -> Outcome:
    """Returns ``meeting_rest``, ``meeting_before`` and ``meeting_after`` (triangles of the skin over all heads, shapes
    and weights), and ``lift_worst_mm``."""
    records, rows = bench.records("inner-mouth", key_of(facekit.sha256, tested)), []
    for number in range(HEADS):
        rows.append({"head": number} | records.row(f"head-{number}", lambda n=number: _row(facekit, n), number / HEADS))
    names = ("meeting_rest", "meeting_before", "meeting_after")
    figures = {name: float(sum(float(row[name]) for row in rows)) for name in names}
    figures["lift_worst_mm"] = max(float(row["lift_mm"]) for row in rows)
    return {"figures": figures, "rows": rows}


def _row(model: HeadModel, number: int) -> Row:
    head, inner = _case(model, number)
    vertices, faces, moves = head.vertices, head.faces, head.moves
    free = keep_off_teeth(vertices, faces, moves, inner)
    lift = {name: float(np.linalg.norm(free[name] - moves[name], axis=1).max()) for name in moves}
    return {
        "parts": len(inner.parts),
        "shapes": len(moves),
        "meeting_rest": _meeting(vertices, faces, moves, inner, (0.0,)),
        "meeting_before": _meeting(vertices, faces, moves, inner, WEIGHTS),
        "meeting_after": _meeting(vertices, faces, free, inner, WEIGHTS),
        "lifted": sum(value > 0.0 for value in lift.values()),
        "lift_mm": max(lift.values()),
        "most_lifted": max(lift, key=lambda name: lift[name]),
    }


def _case(model: HeadModel, number: int) -> tuple[OpenHead, InnerMouth]:
    """Returns a head of the model (the first is its mean) with lips that part, and its teeth and tongue."""
    head = open_head(model, number)
    head = replace(head, moves={TONGUE_OUT: np.zeros_like(head.vertices), **head.moves})
    loose, jaw = np.full(len(head.vertices), -1), jaw_motions(head.landmarks, head.vertices, head.moves)
    return head, place_inner_mouth(head.vertices, head.faces, head.moves, head.landmarks, jaw, loose)


def _posed(vertices: Float[np.ndarray, "v 3"], moves: Moves, name: str, weight: float) -> Float[np.ndarray, "v 3"]:
    return vertices + weight * moves[name] + jaw_weight(name, weight) * moves["jawOpen"]


def _meeting(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    moves: Moves,
    inner: InnerMouth,
    weights: tuple[float, ...],
) -> int:
    """Returns how many triangles of the skin meet a part, over all shapes and some weights."""
    return sum(
        int(meeting_triangles(_posed(vertices, moves, name, weight), faces, inner.posed(name, weight), inner).sum())
        for name in (moves if any(weights) else ("jawOpen",))
        for weight in weights
    )

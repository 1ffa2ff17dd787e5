"""Counts what of the eyeballs behind the lids of a mesh crosses lids (``pipeline.applications.templates.eyeballs``).

The mesh is ICT-FaceKit's own head, whose eyes are open, with the model's true shapes, on heads of its population. An
eyeball's triangles that cross a lid are counted at rest and for each of Apple's shapes at half and at full weight, as
the shapes come and once lids are lifted; then of eyes that look aside, up and down.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.applications.templates import eyeballs as tested
from pipeline.applications.templates import pivots as placing
from pipeline.applications.templates.eyeballs import AHEAD, Eyeball, lift_lids, place_eyeballs
from pipeline.applications.templates.pivots import pivots
from pipeline.evidence.expression import build_blendshape_rig
from pipeline.fusion.crossings import crossing_faces
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import opened_faces
from rig.geometry import Similarity
from rig.mesh import Mesh
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of

SEED, SPREAD = 38, 0.8
HEADS = 5
ABOUT_MM = 22.0  # of an eyeball's centre, in which lids are looked at
TURNED_DEG = 15.0
ASIDE: Mapping[str, tuple[float, float]] = {"left": (1, 0), "right": (-1, 0), "up": (0, 1), "down": (0, -1)}
CROSSING = ("crossing_rest", "crossing_before", "crossing_after", "crossing_turned")


def eyeballs(facekit: HeadModel, *, bench: Bench) -> Outcome:
    """Returns ``crossing_rest``, ``crossing_before`` and ``crossing_after`` (triangles of eyeballs over all heads,
    shapes and weights), ``crossing_turned`` (after, over all directions too, and at rest), and ``lift_worst_mm``."""
    records, rows = bench.records("eyeballs", key_of(facekit.sha256, tested, placing)), []
    for number in range(HEADS):
        rows.append({"head": number} | records.row(f"head-{number}", lambda n=number: _row(facekit, n), number / HEADS))
    figures = {name: float(sum(float(row[name]) for row in rows)) for name in CROSSING}
    figures["lift_worst_mm"] = max(float(row["lift_mm"]) for row in rows)
    return {"figures": figures, "rows": rows}


def _row(model: HeadModel, number: int) -> Row:
    head = open_head(model, number)
    eyes = place(head)
    before = sum(_crossings(head, eyes, move) for move in head.moves.values())
    rest, after, lift = count_crossings(head, eyes)
    turned = [count_crossings(head, place(head, gaze)) for gaze in map(turned_gaze, ASIDE)]
    return {
        "eyeballs": len(eyes),
        "shapes": len(head.moves),
        "crossing_rest": rest,
        "crossing_before": before,
        "crossing_after": after,
        "crossing_turned": sum(at_rest + moved for at_rest, moved, _ in turned),
        "lift_mm": max(lift, *(most for _, _, most in turned)),
    }


@dataclass(frozen=True, slots=True, eq=False)
class OpenHead:
    """Holds a head with open eyes (head frame, mm): its shapes that move something, and the pivots of its eyes."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    moves: Mapping[str, Float[np.ndarray, "v 3"]]
    landmarks: Mapping[str, Float[np.ndarray, " 3"]]
    centres: Mapping[str, Float[np.ndarray, " 3"]]


def open_head(model: HeadModel, number: int) -> OpenHead:
    """Draws a head of the model; the first is its mean."""
    rng = np.random.default_rng((SEED, number))
    z = SPREAD * rng.standard_normal(len(model.modes)) if number else np.zeros(0)
    vertices, whole = model.vertices(z), model.levels["full"].faces
    rig = build_blendshape_rig(model, Similarity.identity(), Mesh(vertices, whole), ())
    moves = {name: shape for name, shape in rig.morphs.items() if np.abs(shape).max() > 0.0}
    landmarks = {name: vertices[row] for name, row in model.landmarks.items()}
    found = pivots(landmarks, vertices, moves, [])
    centres = {name: found[name] for name in ("eye_right", "eye_left")}
    return OpenHead(vertices, opened_faces({"cage": whole, "full": whole}), moves, landmarks, centres)


def turned_gaze(direction: str) -> Float[np.ndarray, " 3"]:
    """Returns where eyes look that are turned by ``TURNED_DEG``."""
    across, up = np.sin(np.radians(TURNED_DEG)) * np.array(ASIDE[direction])
    return np.array([across, up, np.cos(np.radians(TURNED_DEG))])


def place(head: OpenHead, gaze: Float[np.ndarray, " 3"] = AHEAD) -> dict[str, Eyeball]:
    """Returns the eyeballs of a head, both looking along ``gaze``."""
    gazes = dict.fromkeys(head.centres, gaze)
    return place_eyeballs(head.vertices, head.faces, head.landmarks, head.centres, gazes)


def count_crossings(head: OpenHead, eyes: Mapping[str, Eyeball]) -> tuple[int, int, float]:
    """Returns how many triangles of eyeballs cross lids at rest, and over all shapes and weights once lids are lifted;
    and the largest lift (mm)."""
    crossing, lift = 0, 0.0
    for move in head.moves.values():
        free = lift_lids(head.vertices, head.faces, move, eyes)
        lift = max(lift, float(np.linalg.norm(free - move, axis=1).max()))
        crossing += _crossings(head, eyes, free)
    return sum(_crossing(head.vertices, head.faces, eyeball) for eyeball in eyes.values()), crossing, lift


def _crossings(head: OpenHead, eyes: Mapping[str, Eyeball], move: Float[np.ndarray, "v 3"]) -> int:
    return sum(
        _crossing(head.vertices + weight * move, head.faces, eyeball)
        for eyeball in eyes.values()
        for weight in (0.5, 1.0)
    )


def _crossing(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], eyeball: Eyeball) -> int:
    """Returns how many triangles of an eyeball cross the head."""
    ball = eyeball.mesh()
    about = faces[(np.linalg.norm(vertices - eyeball.centre, axis=1) < ABOUT_MM)[faces].any(axis=1)]
    joined = np.concatenate([about, ball.faces + len(vertices)])
    return int(crossing_faces(np.concatenate([vertices, ball.vertices]), joined)[len(about) :].sum())

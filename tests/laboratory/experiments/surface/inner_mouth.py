"""Counts skin that meets teeth and tongue of a mesh (``pipeline.applications.templates.inner_mouth``).

The mesh is ICT-FaceKit's own head, whose lips part, with the model's true shapes, on heads of its population. Triangles
of the skin that meet teeth or tongue are counted at rest and for each of Apple's shapes at half and at full weight, as
the shapes come and once lips are kept off the teeth.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from pipeline.applications.templates import inner_mouth as tested
from pipeline.applications.templates.inner_mouth import (
    WEIGHTS,
    InnerMouth,
    jaw_weight,
    kept_off_teeth,
    meeting_triangles,
    placed_inner_mouth,
)
from pipeline.applications.templates.pivots import jaw_motions
from pipeline.evidence.expression import build_blendshape_rig
from pipeline.head_model import inner_mouth_file
from pipeline.head_model.model import HeadModel
from pipeline.results.clay import SKIN, clay
from rig.geometry import Similarity
from rig.mesh import Mesh
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.surface.eyeballs import HEADS, OPEN_TRIANGLES, SEED, SPREAD

SHOWN = (("jawOpen", 0.3), ("jawOpen", 0.7), ("tongueOut", 1.0), ("mouthFunnel", 1.0), ("mouthRollLower", 1.0))
MOUTH = (np.array([-34.0, -76.0, 66.0]), np.array([34.0, -16.0, 100.0]))  # head frame, mm
Moves = Mapping[str, Float[np.ndarray, "v 3"]]


def inner_mouths(facekit: HeadModel, *, bench: Bench) -> Outcome:
    """Returns ``meeting_rest``, ``meeting_before`` and ``meeting_after`` (triangles of the skin over all heads, shapes
    and weights), and ``lift_worst_mm``."""
    records, rows = bench.records("inner-mouth", key_of(facekit.sha256, tested, inner_mouth_file)), []
    for number in range(HEADS):
        bench.report(f"head {number}", number / HEADS)
        rows.append({"head": number} | records.row(f"head-{number}", lambda number=number: _row(facekit, number)))
    names = ("meeting_rest", "meeting_before", "meeting_after")
    figures = {name: float(sum(float(row[name]) for row in rows)) for name in names}
    figures["lift_worst_mm"] = max(float(row["lift_mm"]) for row in rows)
    pictures = {} if bench.folder is None else {"mouths": _picture(facekit)}
    return {"figures": figures, "rows": rows, "markdown": _table(rows), "pictures": pictures}


def _row(model: HeadModel, number: int) -> Row:
    vertices, faces, moves, inner = _case(model, number)
    free = kept_off_teeth(vertices, faces, moves, inner)
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


def _case(
    model: HeadModel, number: int
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], dict[str, Float[np.ndarray, "v 3"]], InnerMouth]:
    """Returns a head of the model (the first is its mean) with lips that part, its shapes, and teeth and tongue."""
    rng = np.random.default_rng((SEED, number))
    z = SPREAD * rng.standard_normal(len(model.modes)) if number else np.zeros(0)
    vertices, whole = model.vertices(z), model.levels["full"].faces
    moves = dict(build_blendshape_rig(model, Similarity.identity(), Mesh(vertices, whole), ()).morphs)
    landmarks = {name: vertices[row] for name, row in model.landmarks.items()}
    faces, loose = whole[:OPEN_TRIANGLES], np.full(len(vertices), -1)
    jaw = jaw_motions(landmarks, vertices, moves)
    return vertices, faces, moves, placed_inner_mouth(vertices, faces, moves, landmarks, jaw, loose)


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


def _picture(model: HeadModel) -> np.ndarray:
    """Draws the mouth of each head in some poses."""
    rows = []
    for number in range(HEADS):
        vertices, faces, moves, inner = _case(model, number)
        free = kept_off_teeth(vertices, faces, moves, inner)
        for azimuth_deg in (0.0, 30.0):
            drawn = [
                _drawn(_posed(vertices, free, name, weight), faces, inner, inner.posed(name, weight), azimuth_deg)
                for name, weight in SHOWN
            ]
            rows.append(np.hstack(drawn))
    return np.vstack(rows)


def _drawn(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    inner: InnerMouth,
    posed: Mapping[str, Float[np.ndarray, "n 3"]],
    azimuth_deg: float,
) -> np.ndarray:
    colours = np.full(vertices.shape, SKIN, np.uint8)
    for name, part in inner.parts.items():
        faces = np.concatenate([faces, part.faces + len(vertices)])
        vertices = np.concatenate([vertices, posed[name]])
        colours = np.concatenate([colours, np.asarray(part.colours)])
    return clay(Mesh(vertices, faces), colours=colours, azimuth_deg=azimuth_deg, box=MOUTH, darkest=0.45)


def _table(rows: list[Row]) -> str:
    names = ("head", "parts", "shapes", "meeting_rest", "meeting_before", "meeting_after", "lifted")
    cells = [[*(row[name] for name in names), f"{row['lift_mm']:.2f} ({row['most_lifted']})"] for row in rows]
    return markdown.table((*names, "largest lift, mm"), cells)

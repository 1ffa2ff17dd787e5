"""Compares Apple's shapes carried to foreign meshes with how these meshes truly move (``templates.animated``).

The meshes are made of a model's own surface (``foreign_meshes``), so that the true motion of every vertex is the
model's. The last two have the shape of another person when they are registered; shapes are carried on the mean head.
An error is the root mean square over a mesh's vertices, divided by that of the true motion.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from pipeline.applications.templates import animated, carrying, contact, likeness, placement, registration
from pipeline.applications.templates.animated import Neutral, carried_shapes, parted_shapes
from pipeline.applications.templates.contact import WEIGHTS, RestSurface, crossings, prepare_rest_surface
from pipeline.applications.templates.registration import register
from pipeline.evidence.expression import build_blendshape_rig
from pipeline.head_model.model import HeadModel
from pipeline.results.overlays import clay
from rig.geometry import Similarity
from rig.mesh import Mesh
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.surface.foreign_meshes import ForeignMesh, decimated_split, dual, shuffled

SEED = 38
LIMIT = 0.1  # of the motion
BETWEEN = tuple(k / 8.0 for k in range(1, 9))  # weights at which crossings are counted once they are kept apart
OPEN_TRIANGLES = 22288  # of ICT-FaceKit's face and head; what follows in the model closes eyes and mouth
TRIANGLES = 12000  # of the surface that was split and decimated
SHOWN = {
    "jawOpen": ("jawOpen",),
    "smile": ("mouthSmileLeft", "mouthSmileRight"),
    "blink": ("eyeBlinkLeft", "eyeBlinkRight"),
}
FACE = (np.array([-75.0, -115.0, 20.0]), np.array([75.0, 90.0, 110.0]))  # head frame, mm
Moves = Mapping[str, Float[np.ndarray, "t 3"]]


def shapes(model: HeadModel, facekit: HeadModel, *, bench: Bench) -> Outcome:
    """Returns ``<mesh>_carried_worst`` (error of the worst shape as carried), ``<mesh>_parted_worst`` (once lips and
    lids are kept apart), ``<mesh>_crossings`` and so on."""
    modules = (animated, carrying, contact, likeness, placement, registration)
    records = bench.records("shapes", key_of(model.sha256, facekit.sha256, *modules))
    cases = _cases(model, facekit)
    rows: list[Row] = []
    pictures: dict[str, np.ndarray] = {}
    for number, (name, (other, mesh, of_another)) in enumerate(cases.items()):
        bench.report(name, number / len(cases))
        made = mesh()

        def compute(model: HeadModel = other, made: ForeignMesh = made, of_another: bool = of_another) -> Row:
            return _case(model, made, of_another)

        row = records.row(name, compute)
        rows.append({"mesh": name} | {key: value for key, value in row.items() if key != "drawn"})
        pictures[name] = _picture(other, made, row["drawn"])
    figures = {f"{row['mesh']}_{key}": value for row in rows for key, value in row.items() if _is_figure(value)}
    return {"figures": figures, "rows": rows, "markdown": _table(rows), "pictures": pictures}


def _cases(default: HeadModel, facekit: HeadModel) -> dict[str, tuple[HeadModel, Callable[[], ForeignMesh], bool]]:
    """Returns by name the model, the mesh, and whether it is registered in another person's shape."""
    full, coarse = facekit.levels["full"], default.levels["p95"]
    faces = full.faces[:OPEN_TRIANGLES]
    mean = facekit.vertices(np.zeros(0))
    count, of_default = full.count, default.levels["full"].count
    return {
        "facekit": (facekit, lambda: shuffled(faces, np.arange(count), count, SEED), False),
        "makehuman": (default, lambda: shuffled(coarse.faces, coarse.rows, of_default, SEED), False),
        "remeshed": (facekit, lambda: decimated_split(mean, faces, TRIANGLES), True),
        "dual": (facekit, lambda: dual(faces, count), True),
    }


def _is_figure(value: object) -> bool:
    return isinstance(value, int | float)


def _case(model: HeadModel, mesh: ForeignMesh, of_another: bool) -> Row:
    faces, mean = model.levels["full"].faces, model.vertices(np.zeros(0))
    z = np.random.default_rng(SEED).standard_normal(len(model.modes)) if of_another else np.zeros(0)
    file = mesh.file(model.vertices(z))
    found = register(file, model, name="mesh.obj", report=lambda stage, fraction: None)
    triangles, binding = file.triangles(), found.surface_binding
    blendshape_rig = build_blendshape_rig(model, Similarity.identity(), Mesh(mean, faces), ())
    moves = {name: shape for name, shape in blendshape_rig.morphs.items() if np.abs(shape).max() > 0}
    landmarks = {name: mean[row] for name, row in model.landmarks.items()}
    rest = binding.on(mean, faces)
    carried = carried_shapes(binding, triangles, Neutral(mean, faces, rest), moves, landmarks)
    surface = prepare_rest_surface(rest, triangles)
    parted = parted_shapes(surface, carried)
    true = {name: mesh.operator @ shape for name, shape in moves.items()}
    before, after = _errors(carried, true), _errors(parted, true)
    over = sorted(name for name in true if after[name] > LIMIT)
    return {
        "vertices": len(rest),
        "shapes": len(true),
        "carried_median": float(np.median(list(before.values()))),
        "carried_worst": max(before.values()),
        "parted_median": float(np.median(list(after.values()))),
        "parted_worst": max(after.values()),
        "parted_over": len(over),
        "worst": max(after, key=lambda name: after[name]),
        "over": over,
        "over_that_cross": sum(int(_crossing(surface, true, name) > 0) for name in over),
        "crossings_true": sum(_crossing(surface, true, name) for name in true),
        "crossings_carried": sum(_crossing(surface, carried, name) for name in carried),
        "crossings": sum(_crossing(surface, parted, name, BETWEEN) for name in parted),
        "crossing_at_rest": int(surface.excluded.sum()),
        "drawn": {name: np.sum([parted[part] for part in parts], axis=0).tolist() for name, parts in SHOWN.items()}
        | {"rest": rest.tolist()},
    }


def _errors(moves: Moves, true: Moves) -> dict[str, float]:
    return {name: float(np.linalg.norm(moves[name] - true[name]) / np.linalg.norm(true[name])) for name in true}


def _crossing(surface: RestSurface, moves: Moves, name: str, weights: tuple[float, ...] = WEIGHTS) -> int:
    """Returns how many triangles of a mesh cross with a shape, over some weights; ``mouthClose`` with the jaw open."""
    shape = moves[name] + moves["jawOpen"] if name == "mouthClose" else moves[name]
    return int(crossings(surface, shape, weights).sum())


def _picture(model: HeadModel, mesh: ForeignMesh, drawn: Mapping[str, list]) -> np.ndarray:
    triangles, rest = mesh.file(model.vertices(np.zeros(0))).triangles(), np.array(drawn["rest"])
    posed = [rest, *(rest + np.array(drawn[name]) for name in SHOWN)]
    return np.hstack([clay(Mesh(vertices, triangles), azimuth_deg=10.0, box=FACE) for vertices in posed])


def _table(rows: list[Row]) -> str:
    header = ("mesh", "vertices", "carried: median, worst", "kept apart: median, worst", "over 10 %",
              "crossing: true, carried, kept apart")  # fmt: skip
    return markdown.table(
        header,
        [
            [
                row["mesh"],
                row["vertices"],
                f"{row['carried_median']:.1%}, {row['carried_worst']:.1%}",
                f"{row['parted_median']:.1%}, {row['parted_worst']:.1%}",
                f"{row['parted_over']} of {row['shapes']}",
                f"{row['crossings_true']}, {row['crossings_carried']}, {row['crossings']}",
            ]
            for row in rows
        ],
    )

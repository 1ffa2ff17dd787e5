"""Measures how often the warning ``eyes-closed`` is wrong, for eyes that are open, half closed and closed.

Heads of both models in the studio have open, half closed and closed lids; every fourth head moves one eye alone. The
warning is right if it names exactly the eyes whose lids meet; half closed lids do not count as closed.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Float, Int
from trimesh.remesh import subdivide

from pipeline.detail.eyelids import SIDES
from pipeline.head_model.expressions import BLINKS, closed_lids, plain_name
from pipeline.head_model.model import HeadModel
from pipeline.results.reconstruction import Reconstruction
from pipeline.warnings import ReportWarning
from rig.capture import Capture
from rig.errors import EigenheadError, InputError
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row

Job = Callable[[Capture, Rig], Reconstruction]
STATES: Mapping[str, float] = {"open": 0.0, "half": 0.5, "closed": 1.0}
HEADS = 10  # of each model
WINKS_EVERY = 4
SEED, SPREAD = 34, 0.8
PAINTED_MM = 0.6  # edges about an eye; those of ICT-FaceKit are 1.9, as wide as an eye half closed is open


def eyes(
    models: Mapping[str, HeadModel], job: Job, *, renderer: Renderer, key: str, bench: Bench, heads: int = HEADS
) -> Outcome:
    """Runs this module's experiment. Returns ``eyes_wrong`` of ``eyes_heads``, and ``eyes_<state>_wrong``.

    ``models``: from which heads are drawn, by name. ``job``: runs a whole job. ``renderer``: for the studio. ``key``:
    names everything that the rows depend on, as in ``Records``. ``heads``: number for each model, each in all three
    states.
    """
    records, rows = bench.records("people-eyes", key), []
    cases = [*product(range(heads), models.items(), STATES)]
    for done, (number, (label, model), state) in enumerate(cases):
        name = f"{label}-{number:02} {state}"
        row = records.row(name, partial(eye_row, model, number, state, job, renderer), done / len(cases))
        rows.append({"name": name, "state": state, **row})
    return {"figures": figures(rows), "rows": rows, "markdown": table(rows), "lines": table(rows).splitlines()}


def eye_row(model: HeadModel, number: int, state: str, job: Job, renderer: Renderer) -> Row:
    """Runs one job. Returns which eyes are closed, and which ones the warning names."""
    closed = closed_sides(number) if state == "closed" else frozenset[str]()
    shot = photograph_eyes(model, number, STATES[state], renderer)
    try:
        warnings = job(shot.capture, shot.rig).warnings
    except EigenheadError as error:
        return {"closed": sorted(closed), "refused": str(error)[:120], "is_wrong": True}
    named = warned_sides(warnings)
    return {"closed": sorted(closed), "told": sorted(named), "is_wrong": named != closed}


def closed_sides(number: int) -> frozenset[str]:
    """Returns the eyes that head ``number`` closes."""
    return frozenset(SIDES if number % WINKS_EVERY else SIDES[:1])


def warned_sides(warnings: Sequence[ReportWarning]) -> frozenset[str]:
    """Returns the eyes that the warning ``eyes-closed`` names; both if it names none."""
    texts = [warning.text for warning in warnings if warning.code == "eyes-closed"]
    return frozenset(side for side in SIDES for text in texts if side in text or not any(s in text for s in SIDES))


def photograph_eyes(model: HeadModel, number: int, share: float, renderer: Renderer) -> SimulatedCapture:
    """Photographs head ``number`` with its lids closed by ``share``. Raises InputError for a model whose eyes do not
    close."""
    weights = {blink_of(model, side): share for side in closed_sides(number)}
    head = model.posed_vertices(
        SPREAD * np.random.default_rng((SEED, number)).standard_normal(len(model.modes)), weights
    )
    marks = {name: head[row] for name, row in model.landmarks.items()}
    sitter = Subject(
        painted_mesh(head, model, marks), marks, name=f"{model.name}-{number}", closed=closed_lids(weights)
    )
    return simulate(sitter, default_layout(), PRESET, np.random.default_rng((SEED, number, 1)), renderer=renderer)


def painted_mesh(
    head: Float[np.ndarray, "v 3"], model: HeadModel, marks: Mapping[str, Float[np.ndarray, " 3"]]
) -> Mesh:
    """Returns the head with triangles small enough to paint eyes on: the studio's colours are those of vertices. Each
    step halves all edges, which leaves the surface as it is."""
    faces = model.levels["full"].faces
    for side in SIDES:
        inner, outer = (marks[f"{corner}_{side}"] for corner in ("endocanthion", "exocanthion"))
        while _edge_mm(head, faces, (inner + outer) / 2, float(np.linalg.norm(outer - inner)) / 2) > PAINTED_MM:
            head, faces, *_ = subdivide(head, faces)
    return Mesh(head, faces)


def _edge_mm(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], centre: Float[np.ndarray, " 3"], reach_mm: float
) -> float:
    """Returns the median length of the edges about a point."""
    corners = vertices[faces]
    near = np.linalg.norm(corners.mean(axis=1) - centre, axis=1) < reach_mm
    return float(np.median(np.linalg.norm(np.diff(corners[near], axis=1), axis=2)))


def blink_of(model: HeadModel, side: str) -> str:
    """Returns the first expression that closes an eye. Raises InputError where there is none."""
    found = [name for name in model.expressions.names if BLINKS.get(plain_name(name)) == side]
    if not found:
        raise InputError(model.name, [f"closes no {side} eye: import it again with its expressions"])
    return found[0]


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Counts wrong heads, of all and by state."""
    found: dict[str, float] = {"eyes_wrong": sum(row["is_wrong"] for row in rows), "eyes_heads": len(rows)}
    return found | {
        f"eyes_{state}_wrong": sum(row["is_wrong"] for row in rows if row["state"] == state) for state in STATES
    }


def table(rows: Sequence[Row]) -> str:
    """Returns a Markdown table of the rows, in which wrong ones are marked."""
    header = ("head", "closed", "told", "wrong")
    cells = [
        [
            row["name"],
            ", ".join(row["closed"]) or "-",
            row.get("refused") or ", ".join(row["told"]) or "-",
            "wrong" if row["is_wrong"] else "-",
        ]
        for row in rows
    ]
    return markdown.table(header, cells)

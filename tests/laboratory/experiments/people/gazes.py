"""Irises, gaze and pupil distance of heads whose eyes look somewhere known (``pipeline.faces.irises``).

Heads of both models' populations in the simulated studio have eyeballs that look at points about 1.2 m away, up to 30
degrees aside; skins, irises, lamps' highlights and hair differ, and every other picture is as real cameras take them.
The face finder and the irises' own search run on the pictures.
"""

from collections.abc import Mapping
from functools import partial
from types import ModuleType

import numpy as np
from jaxtyping import Float

from pipeline.evidence.pose import pupil_distance
from pipeline.faces import irises as finding
from pipeline.faces import limbus as edges
from pipeline.faces.irises import Iris, find_irises
from pipeline.faces.networks import load_networks
from pipeline.faces.subject import find_subject
from pipeline.head_model.model import HeadModel
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.scene import eyes as studio_eyes
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.scene.subject import Subject, add_eyeballs
from rig.studio.sensor.preset import PRESET, REALISM, made_real
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.surface.shapes import OPEN_TRIANGLES

SEED, SPREAD = 387, 0.8
HEADS = 6  # of each model
GAZE_DEG = (12.0, 6.0)  # deviations of azimuth and elevation
FACEKIT_VERTICES = 11248  # of ICT-FaceKit's face and head
AIMS = {"iris_mm": 0.5, "gaze_deg": 3.0, "pupils_mm": 0.5}
CODE: tuple[ModuleType, ...] = (finding, edges, studio_eyes)


def gazes(models: Mapping[str, HeadModel], *, renderer: Renderer, bench: Bench, subjects: int = HEADS) -> Outcome:
    """Returns for ``iris_mm``, ``gaze_deg`` and ``pupils_mm`` the ``_median``, ``_worst``, ``_met`` (share within the
    aim) and ``_stated`` (root mean square of the errors by their stated deviations), and ``seen`` (share of eyes)."""
    rows: list[Row] = []
    for number in range(subjects):
        for label, model in models.items():
            name = f"{label}-{number:02}"
            bench.report(name, len(rows) / (subjects * len(models)))
            records = bench.records(f"gazes-{label}", key_of(model.sha256, *CODE))
            rows.append({"name": name} | records.row(name, partial(_row, model, number, renderer)))
    return {"figures": _figures(rows), "rows": rows}


def looking_head(model: HeadModel, number: int) -> Subject:
    """Draws a head with eyeballs that look at a point."""
    rng = np.random.default_rng((SEED, number))
    vertices, faces = model.vertices(SPREAD * rng.standard_normal(len(model.modes))), model.levels["full"].faces
    if len(vertices) == FACEKIT_VERTICES:  # what follows closes its eyes and mouth
        faces = faces[:OPEN_TRIANGLES]
    marks = {name: vertices[row] for name, row in model.landmarks.items()}
    azimuth, elevation = rng.normal(0.0, GAZE_DEG)
    sitter = Subject(Mesh(vertices, faces), marks, model.levels["full"].face_region, f"{model.name}-{number}")
    return add_eyeballs(sitter, azimuth, elevation, rng)


def photograph_gaze(model: HeadModel, number: int, renderer: Renderer) -> SimulatedCapture:
    """Photographs head ``number``; odd ones as real cameras take them."""
    preset = made_real(PRESET, tuple(REALISM)) if number % 2 else PRESET
    rng = np.random.default_rng((SEED, number, 1))
    return simulate(looking_head(model, number), default_layout(), preset, rng, renderer=renderer)


def _row(model: HeadModel, number: int, renderer: Renderer) -> Row:
    shot = photograph_gaze(model, number, renderer)
    face = find_subject(shot.capture.images, shot.rig, load_networks()).matched
    if face is None:
        return {"eyes": {}, "causes": ["no face"]}
    found = find_irises(face, shot.capture.images, shot.rig, frozenset())
    out: Row = {"eyes": {}, "causes": []}
    for side, iris in found.items():
        if not isinstance(iris, Iris):
            out["causes"].append(f"{side}: {iris.cause}")
            continue
        true = shot.scene.eyes_world[side]
        off = iris.centre - true.iris_centre
        turn = np.degrees(np.arccos(np.clip(iris.gaze @ true.gaze, -1.0, 1.0)))
        out["eyes"][side] = {
            "iris_mm": float(np.linalg.norm(off)),
            "iris_std_mm": float(np.linalg.norm(iris.centre_std_mm)),
            "gaze_deg": float(turn),
            "gaze_std_deg": float(np.sqrt(2.0) * iris.gaze_std_deg),
            "radius_mm": iris.radius_mm,
            "views": len(iris.views),
        }
    distance = pupil_distance(found)
    if distance is not None:
        apart = shot.scene.eyes_world["left"].centre - shot.scene.eyes_world["right"].centre
        out["pupils_mm"] = distance.value_mm - float(np.linalg.norm(apart))
        out["pupils_std_mm"] = distance.std_mm
    return out


def _errors(rows: list[Row]) -> dict[str, Float[np.ndarray, "n 2"]]:
    """Returns errors and stated deviations by quantity."""
    eyes = [eye for row in rows for eye in row["eyes"].values()]
    pairs = {name: [(eye[name], eye[name.replace("_", "_std_")]) for eye in eyes] for name in ("iris_mm", "gaze_deg")}
    pairs["pupils_mm"] = [(abs(row["pupils_mm"]), row["pupils_std_mm"]) for row in rows if "pupils_mm" in row]
    return {name: np.array(of, float).reshape(-1, 2) for name, of in pairs.items()}


def _figures(rows: list[Row]) -> dict[str, float]:
    out = {"seen": sum(len(row["eyes"]) for row in rows) / (2.0 * len(rows))}
    for name, of in _errors(rows).items():
        if len(of):
            error, stated = of.T
            out[f"{name}_median"], out[f"{name}_worst"] = float(np.median(error)), float(error.max())
            out[f"{name}_met"] = float(np.mean(error <= AIMS[name]))
            out[f"{name}_stated"] = float(np.sqrt(np.mean((error / stated) ** 2)))
    return {name: round(value, 4) for name, value in out.items()}

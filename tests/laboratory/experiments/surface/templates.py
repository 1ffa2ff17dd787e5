"""Measures round trips through a template: heads on a model's vertices are written in the order of a registered mesh,
and compared with the true positions of these vertices.

The mesh is ICT-FaceKit's head in a shuffled order, in centimetres, lying on its side. The heads are random heads of
ICT-FaceKit, so that every vertex has a true position. With ICT-FaceKit as the model, the head is the random head
itself. With another model it is the random head on that model's vertices: each of them is bound to the registered mesh
and carried by the random head, an inverse that has nothing in common with the template but the registration. A round
trip cannot show whether the registration matches the face correctly; the twelve landmarks that ICT-FaceKit names show
that.
"""

import time

import numpy as np
from jaxtyping import Float, Int

from pipeline.applications.model_building.sources.imports import MULTI_PIE
from pipeline.applications.templates import carrying, likeness, placement, registration
from pipeline.applications.templates.carrying import bind_vertices
from pipeline.applications.templates.registration import Registration, register
from pipeline.head_model.model import HeadModel
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.mesh import vertex_normals
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of

SEED = 22
OWN_SHAPE = 1.0  # standard deviations of the head that the third mesh has


def templates(model: HeadModel, facekit: HeadModel, *, bench: Bench, subjects: int = 50) -> Outcome:
    """Runs this module's experiment. Returns ``<model>_median_mm``, ``<model>_p95_mm`` and so on, over all vertices of
    all random heads. ``facekit_drawn`` is ICT-FaceKit with a mesh that has the shape of one random head; ``_marked``
    had the twelve landmarks for its registration."""
    modules = (carrying, likeness, placement, registration)
    key = key_of(facekit.sha256, model.sha256, subjects, *modules)
    records = bench.records("templates", key)
    cases = [("facekit", facekit, False, False), ("facekit_drawn", facekit, True, False)]
    cases += [("default", model, False, False), ("default_marked", model, False, True)]
    rows: list[Row] = []
    for number, (label, fitted, drawn, marked) in enumerate(cases):
        bench.report(label, number / len(cases))
        row = records.row(label, lambda m=fitted, d=drawn, k=marked: _round_trips(m, facekit, d, k, subjects))
        rows.append({"model": label} | row)
    figures = {f"{row['model']}_{name}": value for row in rows for name, value in row.items() if name != "model"}
    header = ("model", "median, mm", "worst draw", "95 %", "landmarks, mm", "off the surface, mm", "on the skin")
    names = ("median_mm", "worst_median_mm", "p95_mm", "landmarks_mm", "off_median_mm", "skin_share")
    table = markdown.table(header, [[row["model"], *(row[name] for name in names)] for row in rows])
    return {"figures": figures, "rows": rows, "markdown": table}


def foreign(
    facekit: HeadModel, shape: Float[np.ndarray, "v 3"], seed: int
) -> tuple[PolygonMesh, Int[np.ndarray, " v"]]:
    """Returns ICT-FaceKit's own mesh in another order, unit and axis convention, and the original index of each
    vertex."""
    order = np.random.default_rng((SEED, seed)).permutation(len(shape))
    place = np.argsort(order)
    faces = facekit.levels["full"].faces
    faces = faces[np.random.default_rng((SEED, seed, 1)).permutation(len(faces))]
    turned = shape[order][:, [2, 0, 1]] / 10.0 + (3.0, -7.0, 11.0)
    corners = place[faces].ravel().astype(np.int32)
    none = np.full(len(corners), -1, np.int32)
    return PolygonMesh(turned, np.full(len(faces), 3, np.int32), corners, np.zeros((0, 2)), none), order


def _round_trips(model: HeadModel, facekit: HeadModel, drawn: bool, marked: bool, draws: int) -> Row:
    rng = np.random.default_rng((SEED, 2))
    coefficients = rng.standard_normal(len(facekit.modes)) * (OWN_SHAPE if drawn else 0.0)
    mesh, order = foreign(facekit, facekit.vertices(coefficients), int(drawn))
    place = np.argsort(order)
    marks = {name: mesh.vertices[place[facekit.landmarks[name]]] for name in MULTI_PIE}
    began = time.perf_counter()
    found = register(
        mesh, model, name="facekit", landmarks=marks if marked else None, report=lambda stage, fraction: None
    )
    took = time.perf_counter() - began
    off, applied = [], 0.0
    for _ in range(draws):
        truth = facekit.vertices(rng.standard_normal(len(facekit.modes)))[order]
        head = _on_model(model, facekit, found, mesh, truth, order)
        began = time.perf_counter()
        written = found.surface_binding.on(head, model.levels["full"].faces)
        applied += time.perf_counter() - began
        off.append(np.linalg.norm(written - truth, axis=1))
    apart = np.array(off)
    skin = apart[:, found.surface_binding.skin]
    return {
        "median_mm": float(np.median(apart)),
        "worst_median_mm": float(np.median(apart, axis=1).max()),
        "p95_mm": float(np.percentile(apart, 95)),
        "skin_median_mm": float(np.median(skin)),
        "skin_p95_mm": float(np.percentile(skin, 95)),
        "landmarks_mm": _landmarks(model, facekit, found, order),
        "register_s": took,
        "apply_ms": 1000.0 * applied / draws,
        **found.figures(),
    }


def _on_model(
    model: HeadModel,
    facekit: HeadModel,
    found: Registration,
    mesh: PolygonMesh,
    truth: Float[np.ndarray, "t 3"],
    order: Int[np.ndarray, " t"],
) -> Float[np.ndarray, "v 3"]:
    """The draw on the model's vertices."""
    if model is facekit:
        return truth[np.argsort(order)]
    rest, faces = found.surface_binding.rest, mesh.triangles()
    bound, _, _ = bind_vertices(found.head, vertex_normals(found.head, model.levels["full"].faces), rest, faces)
    return bound.on(truth, faces)


def _landmarks(model: HeadModel, facekit: HeadModel, found: Registration, order: Int[np.ndarray, " t"]) -> float:
    """Mean distance (mm) on the model's mean between its landmarks and where the mesh's own are put."""
    mean = model.vertices(np.zeros(0))
    put = found.surface_binding.on(mean, model.levels["full"].faces)[np.argsort(order)]
    pairs = [(model.landmarks[name], facekit.landmarks[name]) for name in MULTI_PIE]
    return float(np.mean([np.linalg.norm(mean[ours] - put[theirs]) for ours, theirs in pairs]))

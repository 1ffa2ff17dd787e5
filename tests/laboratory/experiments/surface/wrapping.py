"""Measures how close wrapping brings a template to scans: true heads in ICT-FaceKit's vertex order.

The template is ICT-FaceKit's own mean mesh, registered to its model. The scans are the true heads of the shared
captures, whose seven landmarks are known: where the template's own vertices of these names come to lie says whether
features are in place, which the distance from the surface cannot say.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipeline.applications.templates import likeness, registration
from pipeline.applications.templates.registration import register
from pipeline.applications.templates.template_file import Template
from pipeline.applications.wrapping import scan
from pipeline.applications.wrapping import wrap as steps
from pipeline.applications.wrapping.scan import read_raw_scan
from pipeline.applications.wrapping.wrap import wrap
from pipeline.applications.wrapping.write import wrap_picture
from pipeline.head_model.model import HeadModel
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.progress import discard_progress
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper.span import Truth, read_truth
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of


def wrapping(facekit: HeadModel, truths: Mapping[str, Path], *, bench: Bench) -> Outcome:
    """Runs this module's experiment. Returns ``<scan>_median_mm``, ``<scan>_landmarks_mm`` and so on."""
    modules = (steps, scan, likeness, registration)
    records = bench.records("wrap", key_of(facekit.sha256, *modules))
    pictures: dict[str, np.ndarray] = {}
    rows: list[Row] = []
    template: Template | None = None

    def one(name: str, path: Path) -> Row:
        nonlocal template
        template = template or own_template(facekit)
        wrapped = wrap(read_raw_scan(path / "head.ply"), template, facekit, report=discard_progress)
        pictures[name] = wrap_picture(wrapped)
        apart = _landmarks_mm(wrapped.vertices, facekit, read_truth(path))
        return {**wrapped.figures(), "landmarks_mm": apart, "unit_found": float(wrapped.placed.unit == "mm")}

    for number, (name, path) in enumerate(truths.items()):
        rows.append({"scan": name} | records.row(name, lambda n=name, p=path: one(n, p), number / len(truths)))
    figures = {f"{row['scan']}_{name}": value for row in rows for name, value in row.items() if name != "scan"}
    header = ("scan", "on the scan", "median, mm", "95 %", "all vertices", "scan to template", "landmarks, mm")
    names = ("covered_share", "median_mm", "p95_mm", "all_median_mm", "scan_median_mm", "landmarks_mm")
    table = markdown.table(header, [[row["scan"], *(row[name] for name in names)] for row in rows])
    return {"figures": figures, "rows": rows, "markdown": table, "pictures": pictures}


def own_template(model: HeadModel) -> Template:
    """Returns a model's own mean mesh as a template of that model."""
    faces, mean = model.levels["full"].faces, model.vertices(np.zeros(0))
    corners = faces.ravel().astype(np.int32)
    none = np.full(len(corners), -1, np.int32)
    mesh = PolygonMesh(mean, np.full(len(faces), 3, np.int32), corners, np.zeros((0, 2)), none)
    found = register(mesh, model, name=model.name, report=discard_progress)
    return Template(
        name=model.name,
        source=model.name,
        source_sha256=hashlib.sha256(mean.tobytes()).hexdigest(),
        model_name=model.name,
        model_sha256=model.sha256,
        mesh=PolygonMesh(found.surface_binding.rest, mesh.sizes, corners, mesh.uv, none),
        surface_binding=found.surface_binding,
        figures=found.figures(),
    )


def _landmarks_mm(vertices: np.ndarray, model: HeadModel, truth: Truth) -> float:
    """Returns the mean distance (mm) between the true landmarks and the template's vertices of these names."""
    names = [name for name in truth.features if name in model.landmarks]
    apart = [np.linalg.norm(vertices[model.landmarks[name]] - truth.features[name]) for name in names]
    return float(np.mean(apart))

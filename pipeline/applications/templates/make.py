"""Makes a template for ``eigenhead template add``. Jobs, which only ``load`` one, do not wait for what this imports."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.applications.templates.flame_file import SUFFIXES, read_flame
from pipeline.applications.templates.flame_model import FlameModel
from pipeline.applications.templates.registration import Registration, register
from pipeline.applications.templates.template_file import Template
from pipeline.head_model.model import HeadModel
from rig.formats.meshes.polygon_obj import PolygonMesh, read_polygons
from rig.progress import Progress


def make_template(
    path: Path,
    name: str,
    model: HeadModel,
    *,
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    report: Progress,
) -> tuple[Template, Registration]:
    """Registers the mesh of an OBJ file, or of a FLAME model's file, to a head model. Returns the template and the
    registration. Raises InputError that lists every fault of the file."""
    flame = read_flame(path) if path.suffix.lower() in SUFFIXES else None
    mesh = read_polygons(path) if flame is None else _polygons(flame)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    found = register(mesh, model, name=path.name, landmarks=landmarks, report=report)
    kept = PolygonMesh(found.surface_binding.rest, mesh.sizes, mesh.corners, mesh.uv, mesh.corner_uv, mesh.statements)
    template = Template(
        name=name,
        source=path.name,
        source_sha256=digest,
        model_name=model.name,
        model_sha256=model.sha256,
        mesh=kept,
        surface_binding=found.surface_binding,
        figures=found.figures(),
        flame=flame,
    )
    return template, found


def _polygons(flame: FlameModel) -> PolygonMesh:
    """Returns the mean head of a FLAME model as a mesh without texture coordinates."""
    corners = flame.faces.ravel().astype(np.int32)
    nowhere = np.full(len(corners), -1, np.int32)
    return PolygonMesh(flame.template, np.full(len(flame.faces), 3, np.int32), corners, np.zeros((0, 2)), nowhere)

"""Finds templates by name: loads one for a job, and makes one for ``eigenhead template add``."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.head_model.model import HeadModel
from pipeline.templates.names import template_path
from pipeline.templates.registration import Registration, register
from pipeline.templates.template_file import Template, read_template
from rig.formats.meshes.polygon_obj import PolygonMesh, read_polygons
from rig.progress import Progress


def load_template(name: str | None, model: HeadModel) -> Template | None:
    """Loads the named template for a job with this model; returns None if ``name`` is None.

    Raises UnknownTemplate, BadTemplate, OtherModel.
    """
    if name is None:
        return None
    template = read_template(template_path(name))
    template.check_model(model.name, model.sha256)
    return template


def make_template(
    path: Path,
    name: str,
    model: HeadModel,
    *,
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    report: Progress,
) -> tuple[Template, Registration]:
    """Registers the mesh of an OBJ file to a model. Returns the template and the registration. Raises InputError that
    lists every fault of the file."""
    mesh = read_polygons(path)
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
    )
    return template, found

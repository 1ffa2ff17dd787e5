"""Reads a patient's surface of a CT or CBCT: a mesh in mm, in LPS or RAS, with or without skull and airways in it."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from pipeline.applications.model_building.correspondence.scans import welded
from pipeline.applications.verification.reference import Reference
from rig.formats.meshes.markups import AXES, Axes
from rig.formats.meshes.mesh_file import SURFACE_ENDINGS, read_mesh
from rig.mesh import Mesh

HEADER_BYTES = 4096  # in which SPACE stands: a comment of a PLY or OBJ, the 80 bytes of an STL


@dataclass(frozen=True, slots=True, eq=False)
class PatientSurface:
    """Holds the surface and the axes of its coordinates. ``stated`` tells whether its file states them."""

    reference: Reference
    axes: Axes
    stated: bool


def read_surface(path: Path, axes: Axes | None = None) -> PatientSurface:
    """Reads a .ply, .obj, .glb or .stl. Axes are ``axes``, else those that the file's header states (``SPACE=RAS``, as
    3D Slicer writes it), else LPS. Raises InputError naming every fault."""
    vertices, faces = welded(read_mesh(path, SURFACE_ENDINGS))
    found = _stated_axes(path)
    data = path.read_bytes()
    reference = Reference.of(Mesh(vertices, faces), {}, path.name, hashlib.sha256(data).hexdigest())
    return PatientSurface(reference, axes or found or "LPS", axes is None and found is not None)


def _stated_axes(path: Path) -> Axes | None:
    with path.open("rb") as file:
        header = file.read(HEADER_BYTES)
    return next((axes for axes in AXES if f"SPACE={axes}".encode() in header), None)

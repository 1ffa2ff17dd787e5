"""Reads meshes of other programs: PLY, OBJ, GLB and, where it is asked for, STL, through trimesh."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose

MESH_ENDINGS = (".ply", ".obj", ".glb")
SURFACE_ENDINGS = (*MESH_ENDINGS, ".stl")  # STL has neither colours nor joined vertices


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """Holds a mesh in its file's own unit, with its texture if it has one. Vertices are repeated along seams."""

    mesh: Mesh
    uv: Float[np.ndarray, "v 2"] | None = None  # of the vertices, v upwards
    image: ImageRgb | None = None


def read_mesh(path: Path, endings: tuple[str, ...] = MESH_ENDINGS) -> Mesh:
    """Reads PLY, OBJ, GLB or what else ``endings`` names, in the file's own units. Raises InputError."""
    return _mesh(_loaded(path, endings), path)


def read_textured_mesh(path: Path) -> TexturedMesh:
    """Reads PLY, OBJ or GLB with its texture. A texture that cannot be read is left out. Raises InputError."""
    loaded = _loaded(path)
    mesh, visual = _mesh(loaded, path), loaded.visual
    if visual is None or visual.kind != "texture" or visual.uv is None or len(visual.uv) != len(mesh.vertices):
        return TexturedMesh(mesh)
    picture = getattr(visual.material, "baseColorTexture", None) or getattr(visual.material, "image", None)
    uv = np.asarray(visual.uv, float)
    if picture is None or not np.isfinite(uv).all():
        return TexturedMesh(mesh)
    return TexturedMesh(mesh, uv, np.ascontiguousarray(np.asarray(picture.convert("RGB"), np.uint8)))


def _loaded(path: Path, endings: tuple[str, ...] = MESH_ENDINGS) -> Any:
    import trimesh

    if path.suffix.lower() not in endings:
        raise InputError(path.name, [compose("no-mesh-ending" if endings == MESH_ENDINGS else "no-surface-ending")])
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh lets the parsers' own errors through, of any class
        raise InputError(path.name, [compose("mesh-unread", reason=str(error))]) from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(path.name, [compose("no-triangles")])
    return loaded


def _mesh(loaded: Any, path: Path) -> Mesh:
    vertices = np.asarray(loaded.vertices, dtype=float)
    if not np.isfinite(vertices).all():
        raise InputError(path.name, [compose("vertex-not-finite")])
    coloured = loaded.visual is not None and loaded.visual.kind == "vertex"
    visual = getattr(loaded.visual, "vertex_colors", None) if coloured else None
    colours = None if visual is None else np.ascontiguousarray(np.asarray(visual)[:, :3].astype(np.uint8))
    return Mesh(vertices, np.asarray(loaded.faces, dtype=np.int32), colours)

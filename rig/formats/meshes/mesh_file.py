"""Reads meshes of other programs: PLY, OBJ and GLB, through trimesh."""

from pathlib import Path

import numpy as np

from rig.errors import InputError
from rig.mesh import Mesh
from rig.messages.message import compose


def read_mesh(path: Path) -> Mesh:
    """Reads PLY, OBJ or GLB in the file's own units. Raises InputError."""
    import trimesh

    if path.suffix.lower() not in (".ply", ".obj", ".glb"):
        raise InputError(path.name, [compose("no-mesh-ending")])
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh lets the parsers' own errors through, of any class
        raise InputError(path.name, [compose("mesh-unread", reason=str(error))]) from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(path.name, [compose("no-triangles")])
    vertices = np.asarray(loaded.vertices, dtype=float)
    if not np.isfinite(vertices).all():
        raise InputError(path.name, [compose("vertex-not-finite")])
    coloured = loaded.visual is not None and loaded.visual.kind == "vertex"
    visual = getattr(loaded.visual, "vertex_colors", None) if coloured else None
    colours = None if visual is None else np.ascontiguousarray(np.asarray(visual)[:, :3].astype(np.uint8))
    return Mesh(vertices, np.asarray(loaded.faces, dtype=np.int32), colours)

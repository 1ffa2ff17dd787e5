"""Wavefront OBJ with vertex colours."""

import io

import numpy as np

from rig.mesh import Mesh


def obj_bytes(mesh: Mesh) -> bytes:
    """Wavefront OBJ with the vertex colours that MeshLab and Blender read after the position."""
    colours = mesh.colours if mesh.colours is not None else np.full(mesh.vertices.shape, 200, np.uint8)
    text = io.StringIO()
    np.savetxt(text, np.concatenate([mesh.vertices, colours / 255.0], axis=1), fmt="v %.4f %.4f %.4f %.4f %.4f %.4f")
    np.savetxt(text, mesh.faces + 1, fmt="f %d %d %d")
    return text.getvalue().encode()

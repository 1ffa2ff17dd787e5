"""Writes Wavefront OBJ: with vertex colours, or with texture coordinates, normals and a material."""

import io

import numpy as np
from jaxtyping import Float, Int

from rig.mesh import Mesh

MATERIAL = "skin"


def obj_bytes(mesh: Mesh) -> bytes:
    """Encodes a Wavefront OBJ with the vertex colours that MeshLab and Blender read after the position."""
    colours = mesh.colours if mesh.colours is not None else np.full(mesh.vertices.shape, 200, np.uint8)
    text = io.StringIO()
    np.savetxt(text, np.concatenate([mesh.vertices, colours / 255.0], axis=1), fmt="v %.4f %.4f %.4f %.4f %.4f %.4f")
    np.savetxt(text, mesh.faces + 1, fmt="f %d %d %d")
    return text.getvalue().encode()


def textured_obj_bytes(
    mesh: Mesh,
    *,
    normals: Float[np.ndarray, "v 3"],
    uv: Float[np.ndarray, "n 2"],
    faces_uv: Int[np.ndarray, "f 3"],
    library: str,
) -> bytes:
    """Encodes a Wavefront OBJ whose vertices are the mesh's own: only texture coordinates are doubled at seams.

    Args:
        mesh: the surface.
        normals: unit, of its vertices.
        uv: texture coordinates, v downwards; OBJ's v is upwards.
        faces_uv: of each corner of each face.
        library: name of the .mtl file beside it.
    """
    text = io.StringIO()
    text.write(f"mtllib {library}\no head\nusemtl {MATERIAL}\n")
    np.savetxt(text, mesh.vertices, fmt="v %.4f %.4f %.4f")
    np.savetxt(text, uv * (1, -1) + (0, 1), fmt="vt %.6f %.6f")
    np.savetxt(text, normals, fmt="vn %.4f %.4f %.4f")
    corners = np.stack([mesh.faces, faces_uv, mesh.faces], axis=2).reshape(-1, 9) + 1
    np.savetxt(text, corners, fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
    return text.getvalue().encode()


def mtl_bytes(image: str) -> bytes:
    """Returns the material of ``textured_obj_bytes``; ``image`` is the texture's file name beside it."""
    lines = ("newmtl skin", "Ka 1 1 1", "Kd 1 1 1", "Ks 0.04 0.04 0.04", "Ns 20", "illum 2", f"map_Kd {image}", "")
    return "\n".join(lines).encode()

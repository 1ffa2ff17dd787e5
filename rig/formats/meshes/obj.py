"""Writes Wavefront OBJ: parts as objects, with vertex colours, or with texture coordinates, normals and a material."""

import io

import numpy as np

from rig.formats.meshes.scene import Scene

MATERIAL = "skin"


def scene_obj_bytes(scene: Scene, library: str | None = None) -> bytes:
    """Encodes parts as objects of a Wavefront OBJ, in mm, turned as the scene says.

    Vertices are the meshes' own: only texture coordinates are doubled at seams. A part without a texture has the vertex
    colours that MeshLab and Blender read after the position. ``library`` is the name of the .mtl file beside it.
    """
    text, first, first_uv, first_normal = io.StringIO(), 1, 1, 1
    if library is not None:
        text.write(f"mtllib {library}\n")
    for part in scene.parts:
        about, place = scene.about(part)
        vertices, skin = place.apply(about), part.skin
        text.write(f"o {part.name}\n")
        if skin is None:
            colours = np.full(vertices.shape, 200, np.uint8) if part.mesh.colours is None else part.mesh.colours
            coloured = np.concatenate([vertices, colours / 255.0], axis=1)
            np.savetxt(text, coloured, fmt="v %.4f %.4f %.4f %.4f %.4f %.4f")
            np.savetxt(text, part.mesh.faces + first, fmt="f %d %d %d")
        else:
            text.write(f"usemtl {MATERIAL}\n")
            np.savetxt(text, vertices, fmt="v %.4f %.4f %.4f")
            np.savetxt(text, skin.uv * (1, -1) + (0, 1), fmt="vt %.6f %.6f")  # OBJ's v is upwards
            np.savetxt(text, part.unit_normals() @ place.rotation.T, fmt="vn %.4f %.4f %.4f")
            faces_uv = part.mesh.faces if skin.faces is None else skin.faces
            corners = [part.mesh.faces + first, faces_uv + first_uv, part.mesh.faces + first_normal]
            np.savetxt(text, np.stack(corners, axis=2).reshape(-1, 9), fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
            first_uv, first_normal = first_uv + len(skin.uv), first_normal + len(vertices)
        first += len(vertices)
    return text.getvalue().encode()


def mtl_bytes(image: str) -> bytes:
    """Returns the material of a textured part; ``image`` is the texture's file name beside it."""
    lines = ("newmtl skin", "Ka 1 1 1", "Kd 1 1 1", "Ks 0.04 0.04 0.04", "Ns 20", "illum 2", f"map_Kd {image}", "")
    return "\n".join(lines).encode()

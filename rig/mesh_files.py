"""Mesh files: PLY as the contract fixes it, glTF binary with vertex colours, and reading of PLY, OBJ and GLB.

The writers are our own because trimesh writes neither the extra vertex properties nor the same bytes twice for every
version; reading goes through trimesh.
"""

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from rig.errors import InputError
from rig.files import write_atomically
from rig.mesh import Mesh

PLY_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    + [(name, "u1") for name in ("red", "green", "blue")]
    + [("quality", "<f4"), ("views", "u1")]
)
PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def ply_bytes(
    mesh: Mesh,
    *,
    normals: Float[np.ndarray, "v 3"],
    colours: UInt8[np.ndarray, "v 3"],
    quality: Float[np.ndarray, " v"],
    views: UInt8[np.ndarray, " v"],
    comments: Sequence[str] = (),
) -> bytes:
    """Binary little-endian PLY. ``quality`` is the standard deviation (mm), ``views`` how many images coloured it."""
    vertices = np.empty(len(mesh.vertices), PLY_VERTEX)
    for i, axis in enumerate("xyz"):
        vertices[axis] = mesh.vertices[:, i]
        vertices["n" + axis] = normals[:, i]
    for i, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = colours[:, i]
    vertices["quality"], vertices["views"] = quality, views
    faces = np.empty(len(mesh.faces), PLY_FACE)
    faces["count"], faces["corners"] = 3, mesh.faces
    properties = [f"property {PLY_TYPES[PLY_VERTEX[name].str]} {name}" for name in PLY_VERTEX.names or ()]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(header).encode("ascii") + vertices.tobytes() + faces.tobytes()


def write_ply(path: Path, mesh: Mesh, **properties: Any) -> None:
    """``ply_bytes`` to a file, under a temporary name first."""
    write_atomically(path, ply_bytes(mesh, **properties))


def glb_bytes(mesh: Mesh, *, normals: Float[np.ndarray, "v 3"], colours: UInt8[np.ndarray, "v 3"]) -> bytes:
    """glTF 2.0 binary of a mesh given in the head frame (mm): metres, y up, face towards +z.

    glTF's ``COLOR_0`` is linear, ours is sRGB, so it is converted, as 16 bits so that dark tones survive.
    https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#meshes
    """
    linear = np.round(linear_from_srgb(colours / 255.0) * 65535).astype("<u2")
    colour = np.concatenate([linear, np.full((len(linear), 1), 65535, "<u2")], axis=1)  # padded to 4-byte alignment
    return _glb(mesh, normals, "COLOR_0", colour, None)


def textured_glb_bytes(
    mesh: Mesh, *, normals: Float[np.ndarray, "v 3"], uv: Float[np.ndarray, "v 2"], jpeg: bytes
) -> bytes:
    """The same with a texture in place of vertex colours: ``uv`` from the image's upper left corner, v downwards."""
    return _glb(mesh, normals, "TEXCOORD_0", uv.astype("<f4"), jpeg)


def _glb(mesh: Mesh, normals: np.ndarray, look: str, values: np.ndarray, jpeg: bytes | None) -> bytes:
    """``look`` names the attribute that carries ``values``, colours (16 bits) or texture coordinates."""
    position, index = (mesh.vertices / 1000.0).astype("<f4"), mesh.faces.astype("<u4").ravel()
    arrays = [position.tobytes(), normals.astype("<f4").tobytes(), values.tobytes(), index.tobytes()]
    shape = (
        {"componentType": 5126, "type": "VEC2"}
        if jpeg
        else {"componentType": 5123, "normalized": True} | {"type": "VEC4"}
    )
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": len(position), "type": "VEC3"}
        | {"min": position.min(0).tolist(), "max": position.max(0).tolist()},
        {"bufferView": 1, "componentType": 5126, "count": len(position), "type": "VEC3"},
        {"bufferView": 2, "count": len(position)} | shape,
        {"bufferView": 3, "componentType": 5125, "count": len(index), "type": "SCALAR"},
    ]
    views, offset = [], 0
    for array, target in zip(arrays, (34962, 34962, 34962, 34963), strict=True):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(array), "target": target})
        offset += len(array)
    surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 0.8}
    document = {
        "asset": {"version": "2.0", "generator": "eigenhead"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "head"}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, look: 2}, "indices": 3, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True}],
        "accessors": accessors,
        "bufferViews": views,
    }
    if jpeg:
        surface["baseColorTexture"] = {"index": 0}
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(jpeg)})
        arrays.append(jpeg)
        offset += len(jpeg)
        document |= {
            "images": [{"bufferView": 4, "mimeType": "image/jpeg"}],
            "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],  # clamped to the edge
            "textures": [{"source": 0, "sampler": 0}],
        }
    return _glb_container(document | {"buffers": [{"byteLength": offset}]}, b"".join(arrays))


def write_glb(path: Path, mesh: Mesh, **properties: Any) -> None:
    """``glb_bytes`` to a file, under a temporary name first."""
    write_atomically(path, glb_bytes(mesh, **properties))


def obj_bytes(mesh: Mesh) -> bytes:
    """Wavefront OBJ with the vertex colours that MeshLab and Blender read after the position."""
    colours = mesh.colours if mesh.colours is not None else np.full(mesh.vertices.shape, 200, np.uint8)
    text = io.StringIO()
    np.savetxt(text, np.concatenate([mesh.vertices, colours / 255.0], axis=1), fmt="v %.4f %.4f %.4f %.4f %.4f %.4f")
    np.savetxt(text, mesh.faces + 1, fmt="f %d %d %d")
    return text.getvalue().encode()


def read_mesh(path: Path) -> Mesh:
    """Reads PLY, OBJ or GLB in the file's own units. Raises InputError."""
    import trimesh

    if path.suffix.lower() not in (".ply", ".obj", ".glb"):
        raise InputError(path.name, ["is no .ply, .obj or .glb"])
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh lets the parsers' own errors through, of any class
        raise InputError(path.name, [f"cannot be read as a mesh ({error})"]) from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(path.name, ["holds no triangles"])
    vertices = np.asarray(loaded.vertices, dtype=float)
    if not np.isfinite(vertices).all():
        raise InputError(path.name, ["holds a vertex that is not finite"])
    coloured = loaded.visual is not None and loaded.visual.kind == "vertex"
    visual = getattr(loaded.visual, "vertex_colors", None) if coloured else None
    colours = None if visual is None else np.ascontiguousarray(np.asarray(visual)[:, :3].astype(np.uint8))
    return Mesh(vertices, np.asarray(loaded.faces, dtype=np.int32), colours)


def linear_from_srgb(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """IEC 61966-2-1, values 0 to 1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """IEC 61966-2-1, values 0 to 1; clipped."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def _glb_container(document: dict[str, Any], payload: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    payload += b"\0" * (-len(payload) % 4)
    length = 12 + 8 + len(text) + 8 + len(payload)
    header = struct.pack("<4sII", b"glTF", 2, length)
    return (
        header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(payload), b"BIN\0") + payload
    )

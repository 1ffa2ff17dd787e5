"""glTF binary with vertex colours or a texture. The writer is our own: trimesh's bytes differ between versions."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from rig.atomic_write import write_atomically
from rig.colour_space import linear_from_srgb
from rig.mesh import Mesh


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
    surface: dict[str, object] = {"metallicFactor": 0, "roughnessFactor": 0.8}
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


def _glb_container(document: Mapping[str, object], payload: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    payload += b"\0" * (-len(payload) % 4)
    length = 12 + 8 + len(text) + 8 + len(payload)
    header = struct.pack("<4sII", b"glTF", 2, length)
    return (
        header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(payload), b"BIN\0") + payload
    )

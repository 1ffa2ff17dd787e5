"""Writes binary glTF with vertex colours or a texture. It does not use trimesh, whose bytes differ between versions."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from rig.atomic_write import write_atomically
from rig.colour_space import linear_from_srgb
from rig.formats.meshes.glb_document import closed_glb
from rig.mesh import Mesh

ROUGHNESS = 0.55  # glTF's roughness of skin: 0.4 on an oily nose, 0.7 on a cheek
WEBP, TEXTURE_WEBP = "image/webp", "EXT_texture_webp"  # glTF 2.0 itself knows JPEG and PNG alone
SPECULAR = "KHR_materials_specular"  # viewers that do not know it mirror evenly
FLOAT, UINT, USHORT = 5126, 5125, 5123
VERTICES, INDICES = 34962, 34963


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """Holds a texture: coordinates for each vertex (from the image's upper left corner, v downwards) and the encoded
    image.

    With a normal map (PNG, linear, +Y up), ``tangents`` are the tangents to which it refers, with the signs of the
    bitangents. ``specular`` is the strength of mirrored light, the alpha of a PNG (KHR_materials_specular).
    """

    uv: Float[np.ndarray, "v 2"]
    image: bytes
    mime: str = "image/jpeg"
    normal_map: bytes | None = None
    tangents: Float[np.ndarray, "v 4"] | None = None
    specular: bytes | None = None

    @property
    def maps(self) -> tuple[bytes, ...]:
        """Returns the encoded images after the texture, all PNG: normal map, specular strength."""
        return tuple(image for image in (self.normal_map, self.specular) if image is not None)


def glb_bytes(
    mesh: Mesh,
    *,
    normals: Float[np.ndarray, "v 3"],
    colours: UInt8[np.ndarray, "v 3"] | None = None,
    skin: Skin | None = None,
    extras: Mapping[str, Any] | None = None,
) -> bytes:
    """Encodes a glTF 2.0 binary of a mesh in the head frame (mm): metres, y up, face towards +z.

    glTF's ``COLOR_0`` is linear and ours is sRGB. It is converted, to 16 bits so that dark tones are kept.
    https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#meshes

    Args:
        mesh: the surface.
        normals: unit, of its vertices.
        colours: sRGB, if there is no texture.
        skin: the texture.
        extras: written as ``asset.extras``.
    """
    parts, attributes = _parts(mesh, normals, colours, skin)
    views, payload = [], bytearray()
    for data, target, _ in parts:
        views.append({"buffer": 0, "byteOffset": len(payload), "byteLength": len(data), "target": target})
        payload += data
    surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": ROUGHNESS}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "eigenhead"} | ({"extras": dict(extras)} if extras else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "head"}],
        "meshes": [{"name": "head", "primitives": [{"attributes": attributes, "indices": 2, "material": 0}]}],
        "materials": [{"name": "skin", "pbrMetallicRoughness": surface, "doubleSided": True} | _maps(skin)],
        "accessors": [{"bufferView": k} | shape for k, (_, _, shape) in enumerate(parts)],
        "bufferViews": views,
    }
    if skin is not None:
        surface["baseColorTexture"] = {"index": 0}
        document |= _texture(skin, len(views))
        for image in (skin.image, *skin.maps):
            views.append({"buffer": 0, "byteOffset": len(payload), "byteLength": len(image)})
            payload += image
    return closed_glb(document, payload)


Part = tuple[bytes, int, dict[str, Any]]  # data, what they are for, and their accessor


def _parts(
    mesh: Mesh, normals: np.ndarray, colours: np.ndarray | None, skin: Skin | None
) -> tuple[list[Part], dict[str, int]]:
    """Returns the buffers of positions, normals, faces and colours or texture, and which buffer serves which
    attribute."""
    position, index = (mesh.vertices / 1000.0).astype("<f4"), mesh.faces.astype("<u4").ravel()
    unit = normals.astype("<f4")
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    bounds = {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
    parts: list[Part] = [
        (position.tobytes(), VERTICES, {"componentType": FLOAT, "count": len(position), "type": "VEC3"} | bounds),
        (unit.tobytes(), VERTICES, {"componentType": FLOAT, "count": len(position), "type": "VEC3"}),
        (index.tobytes(), INDICES, {"componentType": UINT, "count": len(index), "type": "SCALAR"}),
    ]
    attributes = {"POSITION": 0, "NORMAL": 1}
    if skin is not None:
        shape = {"componentType": FLOAT, "count": len(position), "type": "VEC2"}
        parts.append((skin.uv.astype("<f4").tobytes(), VERTICES, shape))
        attributes["TEXCOORD_0"] = 3
        if skin.tangents is not None:
            shape = {"componentType": FLOAT, "count": len(position), "type": "VEC4"}
            parts.append((skin.tangents.astype("<f4").tobytes(), VERTICES, shape))
            attributes["TANGENT"] = 4
    elif colours is not None:
        linear = np.round(linear_from_srgb(colours / 255.0) * 65535).astype("<u2")
        padded = np.concatenate([linear, np.full((len(linear), 1), 65535, "<u2")], axis=1)  # 4-byte alignment
        shape = {"componentType": USHORT, "normalized": True, "count": len(position), "type": "VEC4"}
        parts.append((padded.tobytes(), VERTICES, shape))
        attributes["COLOR_0"] = 3
    return parts, attributes


def _maps(skin: Skin | None) -> dict[str, Any]:
    """Returns what a material says of the images after its texture."""
    found: dict[str, Any] = {}
    if skin is not None and skin.normal_map is not None:
        found["normalTexture"] = {"index": 1}
    if skin is not None and skin.specular is not None:
        found["extensions"] = {SPECULAR: {"specularTexture": {"index": len(skin.maps)}}}
    return found


def _texture(skin: Skin, view: int) -> dict[str, Any]:
    """Returns glTF's images, textures and samplers, with images from buffer view ``view`` on: the texture, then its
    maps."""
    webp, maps = skin.mime == WEBP, range(1, 1 + len(skin.maps))
    source = {"extensions": {TEXTURE_WEBP: {"source": 0}}} if webp else {"source": 0}
    required = [TEXTURE_WEBP] if webp else []
    used = required + ([SPECULAR] if skin.specular is not None else [])
    return {
        "images": [
            {"bufferView": view, "mimeType": skin.mime},
            *({"bufferView": view + k, "mimeType": "image/png"} for k in maps),
        ],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],  # clamped to the edge
        "textures": [{"sampler": 0} | source, *({"sampler": 0, "source": k} for k in maps)],
        **({"extensionsUsed": used} if used else {}),
        **({"extensionsRequired": required} if required else {}),
    }


def write_glb(path: Path, mesh: Mesh, **properties: Any) -> None:
    """Writes ``glb_bytes`` to a file, under a temporary name first."""
    write_atomically(path, glb_bytes(mesh, **properties))

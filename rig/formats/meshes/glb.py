"""Writes binary glTF files with meshes, vertex colours or textures, morph targets, and nodes at the pivots of parts.
The library trimesh is not used, because its output differs between versions.

If a scene has pivots, the top node is ``neck``, at the joint of skull and spine. The child nodes of ``neck`` are the
parts that turn with it, and a node for every other pivot (``jaw``, ``eye_right``, ``eye_left``). A part with the name
of a pivot is the mesh of the pivot's node. Morph targets are sparse, because an expression moves only a part of the
face. Morph targets' names are in ``extras.targetNames``, where three.js and Blender read them.
"""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.colour_space import linear_from_srgb
from rig.formats.meshes.scene import NECK, Part, Scene, quaternion
from rig.mesh import vertex_normals

ROUGHNESS = 0.55  # glTF's roughness of skin: 0.4 on an oily nose, 0.7 on a cheek
WEBP, TEXTURE_WEBP = "image/webp", "EXT_texture_webp"  # glTF 2.0 itself knows JPEG and PNG alone
SPECULAR = "KHR_materials_specular"  # viewers that do not know it mirror evenly
COMPONENTS = {"<f4": 5126, "<u4": 5125, "<u2": 5123}
VERTICES, INDICES = 34962, 34963
LEAST_MM = 0.005  # smaller displacements are left out
LEAST_TURN = 1e-3  # smaller changes of a unit normal are left out
GREY = 200  # of a mesh without colours


def scene_glb_bytes(scene: Scene, extras: Mapping[str, Any] | None = None) -> bytes:
    """Encodes a scene as binary glTF 2.0 in metres, with y up and the face towards +z. ``extras`` is written as
    ``asset.extras``."""
    writer = _Writer(extras)
    document = writer.document
    below: dict[str, list[int]] = {NECK: []}
    for part in scene.parts:
        vertices, _ = scene.about(part)
        node: dict[str, Any] = {"name": part.name, "mesh": writer.append_mesh(part, vertices)}
        if part.rows is not None:
            node["extras"] = {"rows": list(part.rows)}
        document["nodes"].append(node)
        if part.name not in scene.pivots_mm:
            below.setdefault(part.pivot, []).append(len(document["nodes"]) - 1)
    if scene.pivots_mm:
        _append_pivots(document["nodes"], scene, below)
        document["scenes"][0]["nodes"] = [len(document["nodes"]) - 1]
    else:
        document["scenes"][0]["nodes"] = below[NECK]
    return writer.encoded()


def _append_pivots(nodes: list[dict[str, Any]], scene: Scene, below: dict[str, list[int]]) -> None:
    """Appends the nodes of pivots. The last node, ``neck``, is the parent of all others."""
    neck = scene.pivots_mm[NECK] / 1000.0
    for number in below[NECK]:
        nodes[number]["translation"] = (-neck).tolist()
    for name, pivot in scene.pivots_mm.items():
        if name == NECK:
            continue
        number = next((k for k, node in enumerate(nodes) if node["name"] == name), len(nodes))
        if number == len(nodes):
            nodes.append({"name": name})
        nodes[number]["translation"] = (pivot / 1000.0 - neck).tolist()
        if name in scene.turns and "mesh" in nodes[number]:
            nodes[number]["rotation"] = quaternion(scene.turns[name]).tolist()
        if below.get(name):
            nodes[number]["children"] = below[name]
        below[NECK].append(number)
    nodes.append({"name": NECK, "translation": neck.tolist(), "children": below[NECK]})


class _Writer:
    """Collects the JSON document and the binary buffer of a GLB file."""

    def __init__(self, extras: Mapping[str, Any] | None) -> None:
        self.payload = bytearray()
        asset = {"version": "2.0", "generator": "eigenhead"} | ({"extras": dict(extras)} if extras else {})
        self.document: dict[str, Any] = {"asset": asset, "scene": 0, "scenes": [{}], "nodes": [], "meshes": []}
        self.document |= {"materials": [], "accessors": [], "bufferViews": []}
        self._textures: dict[bytes, int] = {}

    def encoded(self) -> bytes:
        """Returns the bytes of the GLB file."""
        data = bytes(self.payload) + b"\0" * (-len(self.payload) % 4)
        text = json.dumps(self.document | {"buffers": [{"byteLength": len(data)}]}, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        header = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
        return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data

    def append_mesh(self, part: Part, vertices: Float[np.ndarray, "v 3"]) -> int:
        """Appends a part as a mesh and returns the mesh's index. Vertices (mm) are relative to the part's node.

        The sRGB colours are converted to linear values for glTF's ``COLOR_0``, with 16 bits to keep dark tones
        distinct. https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#meshes
        """
        skin, colours = part.skin, part.mesh.colours
        rows = np.arange(len(vertices)) if skin is None or skin.source is None else skin.source
        faces = part.mesh.faces if skin is None or skin.faces is None else skin.faces
        unit = part.unit_normals()[rows]
        unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        arrays = {"POSITION": vertices[rows] / 1000.0, "NORMAL": unit}
        if skin is not None:
            arrays |= {"TEXCOORD_0": skin.uv} | ({} if skin.tangents is None else {"TANGENT": skin.tangents})
        attributes = {name: self._accessor(array.astype("<f4"), VERTICES) for name, array in arrays.items()}
        self._bound(attributes["POSITION"], arrays["POSITION"])
        if skin is None:
            shown = np.full((len(rows), 3), GREY, np.uint8) if colours is None else colours
            linear = np.round(linear_from_srgb(shown / 255.0) * 65535).astype("<u2")
            padded = np.concatenate([linear, np.full((len(rows), 1), 65535, "<u2")], axis=1)  # 4-byte alignment
            attributes["COLOR_0"] = self._accessor(padded, VERTICES, normalized=True)
        index = self._accessor(faces.astype("<u4").ravel(), INDICES)
        primitive = {"attributes": attributes, "indices": index, "material": self._material(part)}
        mesh: dict[str, Any] = {"name": part.name, "primitives": [primitive]}
        if part.morphs:
            primitive["targets"] = self._targets(part, rows)
            mesh["weights"] = [float(part.weights.get(name, 0.0)) for name in part.morphs]
            mesh["extras"] = {"targetNames": list(part.morphs)}
        self.document["meshes"].append(mesh)
        return len(self.document["meshes"]) - 1

    def _targets(self, part: Part, rows: np.ndarray) -> list[dict[str, int]]:
        vertices, faces, targets = part.mesh.vertices, part.mesh.faces, []
        normals = vertex_normals(vertices, faces)
        for displacement in part.morphs.values():
            turned = vertex_normals(vertices + displacement, faces) - normals
            moved = displacement[rows] / 1000.0
            position = self._sparse(moved, LEAST_MM / 1000.0)
            self._bound(position, np.where(np.abs(moved).max(axis=1, keepdims=True) > LEAST_MM / 1000.0, moved, 0.0))
            targets.append({"POSITION": position, "NORMAL": self._sparse(turned[rows], LEAST_TURN)})
        return targets

    def _material(self, part: Part) -> int:
        """Returns the index of a part's material. Appends a material for each part with a texture."""
        materials, skin = self.document["materials"], part.skin
        surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": ROUGHNESS}
        name = "colours" if skin is None else "skin" if not materials else part.name
        material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
        if skin is None:
            if material in materials:
                return materials.index(material)
        else:
            surface["baseColorTexture"] = {"index": self._texture(skin.image, skin.mime)}
            if skin.normal_map is not None:
                material["normalTexture"] = {"index": self._texture(skin.normal_map, "image/png")}
            if skin.specular is not None:
                texture = {"index": self._texture(skin.specular, "image/png")}
                material["extensions"] = {SPECULAR: {"specularTexture": texture}}
                self._use(SPECULAR)
        materials.append(material)
        return len(materials) - 1

    def _texture(self, image: bytes, mime: str) -> int:
        """Returns the index of the texture of an encoded image. Identical images share one texture of the GLB file."""
        if image in self._textures:
            return self._textures[image]
        self.document.setdefault("samplers", [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}])
        images, textures = (self.document.setdefault(key, []) for key in ("images", "textures"))
        images.append({"bufferView": self._view(image), "mimeType": mime})
        source = {"source": len(images) - 1}
        if mime == WEBP:
            self._use(TEXTURE_WEBP, "extensionsRequired")
        textures.append({"sampler": 0} | ({"extensions": {TEXTURE_WEBP: source}} if mime == WEBP else source))
        self._textures[image] = len(textures) - 1
        return self._textures[image]

    def _use(self, extension: str, *lists: str) -> None:
        for key in ("extensionsUsed", *lists):
            if extension not in self.document.setdefault(key, []):
                self.document[key].append(extension)

    def _view(self, data: bytes, target: int | None = None) -> int:
        """Appends bytes to the buffer and returns the index of their buffer view. ``target`` is glTF's
        ``bufferView.target``."""
        self.payload.extend(b"\0" * (-len(self.payload) % 4))
        view = {"buffer": 0, "byteOffset": len(self.payload), "byteLength": len(data)}
        self.document["bufferViews"].append(view | ({} if target is None else {"target": target}))
        self.payload.extend(data)
        return len(self.document["bufferViews"]) - 1

    def _accessor(self, array: np.ndarray, target: int, **more: Any) -> int:
        kind: dict[str, Any] = {"componentType": COMPONENTS[array.dtype.str], "count": len(array)}
        kind["type"] = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        self.document["accessors"].append({"bufferView": self._view(array.tobytes(), target)} | kind | more)
        return len(self.document["accessors"]) - 1

    def _sparse(self, values: Float[np.ndarray, "n 3"], least: float) -> int:
        """Appends a sparse accessor of the rows whose values exceed ``least``, and returns its index."""
        rows = np.flatnonzero(np.abs(values).max(axis=1) > least)
        accessor: dict[str, Any] = {"componentType": COMPONENTS["<f4"], "count": len(values), "type": "VEC3"}
        if len(rows):
            indices = {"bufferView": self._view(rows.astype("<u4").tobytes()), "componentType": COMPONENTS["<u4"]}
            moved = {"bufferView": self._view(values[rows].astype("<f4").tobytes())}
            accessor["sparse"] = {"count": len(rows), "indices": indices, "values": moved}
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def _bound(self, number: int, values: Float[np.ndarray, "n 3"]) -> None:
        single = values.astype("<f4")
        bounds = {"min": single.min(axis=0).tolist(), "max": single.max(axis=0).tolist()}
        self.document["accessors"][number] |= bounds

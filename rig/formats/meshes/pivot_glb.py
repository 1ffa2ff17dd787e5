"""Adds the points that a head's parts turn about, eyeballs that can turn, and teeth and tongue, to a binary glTF.

The nodes: ``neck`` over all others, at the joint of skull and spine; under it ``head`` (the mesh that was there), and a
node at every other pivot, ``jaw``, ``eye_right``, ``eye_left``. A part's vertices are relative to its pivot, so that
turning its node turns the part. Teeth and tongue are nodes under the pivot that they move with."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.colour_space import linear_from_srgb
from rig.formats.meshes.glb import FLOAT, INDICES, UINT, USHORT, VERTICES
from rig.formats.meshes.glb_document import appended_view, closed_glb, opened_glb
from rig.formats.meshes.morph_glb import append_targets
from rig.geometry import vector_from_rotation
from rig.mesh import Mesh

NECK = "neck"


@dataclass(frozen=True, slots=True, eq=False)
class MovingPart:
    """Holds a part under a pivot: its mesh (mm, in the head's frame), its displacements by name (mm, at weight 1), and
    the weights that it is shown with."""

    pivot: str
    mesh: Mesh
    morphs: Mapping[str, Float[np.ndarray, "v 3"]]
    weights: Mapping[str, float]


NONE: Mapping[str, MovingPart] = {}
UNTURNED: Mapping[str, Float[np.ndarray, "3 3"]] = {}


def with_pivots(
    glb: bytes,
    pivots_mm: Mapping[str, Float[np.ndarray, " 3"]],
    parts: Mapping[str, Mesh],
    rows: Mapping[str, Any],
    moving: Mapping[str, MovingPart] = NONE,
    turns: Mapping[str, Float[np.ndarray, "3 3"]] = UNTURNED,
) -> bytes:
    """Returns a GLB of this project, of one mesh, with nodes at pivots and with parts.

    Args:
        glb: of one mesh.
        pivots_mm: by name, ``neck`` among them, in the mesh's frame, mm.
        parts: the meshes (mm, in that frame) of some pivots, with colours.
        rows: what ``extras.rows`` of a node says: which vertices of a file its mesh has.
        moving: parts by name that become nodes of their own.
        turns: rotations of pivots, which turn what is under them; ``parts`` are as they are without.
    """
    document, payload = opened_glb(glb)
    neck = pivots_mm[NECK] / 1000.0
    head = document["nodes"][0]
    head["translation"] = (-neck).tolist()
    for name, pivot in pivots_mm.items():
        if name == NECK:
            continue
        node: dict[str, Any] = {"name": name, "translation": (pivot / 1000.0 - neck).tolist()}
        if name in turns:
            node["rotation"] = quaternion(turns[name]).tolist()
        if name in parts:
            part = parts[name]
            about = Mesh(part.vertices - pivot, part.faces, part.colours)
            document["meshes"].append({"name": name, "primitives": [_primitive(document, payload, about)]})
            node["mesh"] = len(document["meshes"]) - 1
        document["nodes"].append(node)
    children = list(range(len(document["nodes"])))
    for node in document["nodes"]:
        if node["name"] in rows:
            node["extras"] = {"rows": rows[node["name"]]}
    for name, part in moving.items():
        number = _append_moving(document, payload, name, part, pivots_mm[part.pivot])
        if part.pivot == NECK:
            children.append(number)
        else:
            above = next(node for node in document["nodes"] if node["name"] == part.pivot)
            above.setdefault("children", []).append(number)
    document["nodes"].append({"name": NECK, "translation": neck.tolist(), "children": children})
    document["scenes"][0]["nodes"] = [len(document["nodes"]) - 1]
    return closed_glb(document, payload)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Returns a rotation as a unit quaternion x, y, z, w."""
    vector = vector_from_rotation(rotation)
    angle = float(np.linalg.norm(vector))
    return np.append(vector * (0.5 * np.sinc(angle / (2.0 * np.pi))), np.cos(0.5 * angle))


def _append_moving(
    document: dict[str, Any], payload: bytearray, name: str, part: MovingPart, pivot_mm: Float[np.ndarray, " 3"]
) -> int:
    """Appends the node of a part, whose vertices are relative to its pivot, and returns its number."""
    about = Mesh(part.mesh.vertices - pivot_mm, part.mesh.faces, part.mesh.colours)
    document["meshes"].append({"name": name, "primitives": [_primitive(document, payload, about)]})
    number = len(document["meshes"]) - 1
    if part.morphs:
        append_targets(document, payload, number, about, part.morphs, weights=part.weights)
    document["nodes"].append({"name": name, "mesh": number})
    return len(document["nodes"]) - 1


def _primitive(document: dict[str, Any], payload: bytearray, mesh: Mesh) -> dict[str, Any]:
    position = (mesh.vertices / 1000.0).astype("<f4")
    colours = np.full((len(position), 3), 255, np.uint8) if mesh.colours is None else mesh.colours
    linear = np.round(linear_from_srgb(colours / 255.0) * 65535).astype("<u2")
    padded = np.concatenate([linear, np.full((len(linear), 1), 65535, "<u2")], axis=1)
    bounds = {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    arrays: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
        "POSITION": (position, {"componentType": FLOAT, "type": "VEC3"} | bounds),
        "NORMAL": (mesh.normals().astype("<f4"), {"componentType": FLOAT, "type": "VEC3"}),
        "COLOR_0": (padded, {"componentType": USHORT, "normalized": True, "type": "VEC4"}),
    }
    attributes = {
        name: _accessor(document, payload, array, shape | {"count": len(array)}, VERTICES)
        for name, (array, shape) in arrays.items()
    }
    index = mesh.faces.astype("<u4").ravel()
    shape = {"componentType": UINT, "type": "SCALAR", "count": len(index)}
    indices = _accessor(document, payload, index, shape, INDICES)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _accessor(
    document: dict[str, Any], payload: bytearray, array: np.ndarray, shape: dict[str, Any], target: int
) -> int:
    document["accessors"].append({"bufferView": appended_view(document, payload, array, target)} | shape)
    return len(document["accessors"]) - 1

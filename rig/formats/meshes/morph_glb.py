"""Adds morph targets to a binary glTF. Accessors are sparse, since an expression moves only a part of the face.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#morph-targets. Names are stored in ``extras.targetNames``,
where three.js, Blender and others look for them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.formats.meshes.glb_document import appended_view, closed_glb, opened_glb
from rig.mesh import Mesh, vertex_normals

LEAST_MM = 0.005  # smaller displacements are left out
LEAST_TURN = 1e-3  # smaller changes of a unit normal are left out


def with_morphs(
    glb: bytes,
    vertices: Float[np.ndarray, "v 3"],
    faces: np.ndarray,
    morphs: Mapping[str, Float[np.ndarray, "v 3"]],
    weights: Mapping[str, float],
) -> bytes:
    """Returns a GLB of this project with morph targets.

    Args:
        glb: of one mesh with one primitive, whose vertices are the given ones in their order, in metres.
        vertices: mm, as the GLB has them at rest.
        faces: its triangles.
        morphs: displacements by name, mm, at weight 1.
        weights: by name, those that the mesh is shown with.
    """
    document, payload = opened_glb(glb)
    append_targets(document, payload, 0, Mesh(vertices, faces), morphs, weights=weights)
    return closed_glb(document, payload)


def append_targets(
    document: dict[str, Any],
    payload: bytearray,
    number: int,
    mesh: Mesh,
    morphs: Mapping[str, Float[np.ndarray, "v 3"]],
    *,
    weights: Mapping[str, float],
) -> None:
    """Appends morph targets to mesh ``number`` of a document, whose one primitive is the given mesh (mm)."""
    vertices, faces = mesh.vertices, mesh.faces
    normals, targets = vertex_normals(vertices, faces), []
    for displacement in morphs.values():
        turned = vertex_normals(vertices + displacement, faces) - normals
        targets.append(
            {
                "POSITION": _sparse(document, payload, displacement / 1000.0, LEAST_MM / 1000.0, bounds=True),
                "NORMAL": _sparse(document, payload, turned, LEAST_TURN, bounds=False),
            }
        )
    written = document["meshes"][number]
    written["primitives"][0]["targets"] = targets
    written["weights"] = [float(weights.get(name, 0.0)) for name in morphs]
    written["extras"] = {"targetNames": list(morphs)}


def _sparse(
    document: dict[str, Any], payload: bytearray, values: Float[np.ndarray, "v 3"], least: float, *, bounds: bool
) -> int:
    """Appends a sparse accessor of the values that are not nearly zero, and returns its index."""
    rows = np.flatnonzero(np.abs(values).max(axis=1) > least)
    moved = values[rows].astype("<f4")
    accessor: dict[str, Any] = {"componentType": 5126, "count": len(values), "type": "VEC3"}
    if len(rows):
        accessor["sparse"] = {
            "count": len(rows),
            "indices": {"bufferView": appended_view(document, payload, rows.astype("<u4")), "componentType": 5125},
            "values": {"bufferView": appended_view(document, payload, moved)},
        }
    if bounds:
        still = [np.zeros((1, 3), "<f4")] if len(rows) < len(values) else []
        whole = np.concatenate([moved, *still])
        accessor |= {"min": whole.min(axis=0).tolist(), "max": whole.max(axis=0).tolist()}
    document["accessors"].append(accessor)
    return len(document["accessors"]) - 1

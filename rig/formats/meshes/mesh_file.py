"""Reads meshes of other programs: PLY, OBJ, GLB and, where it is asked for, STL, through trimesh.

trimesh passes over glTF's normalised integers, sparse accessors and compressions without an error. The first two become
plain numbers here before it reads the file; a compression is refused by its name
(https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6.2 and 3.12)."""

import io
import json
import logging
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.formats.meshes.glb_document import appended_view, closed_glb
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose

MESH_ENDINGS = (".ply", ".obj", ".glb")
UNDERSTOOD = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_materials_", "KHR_lights_")
COMPRESSIONS = {"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshopt"}
KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # glTF's component types
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
SURFACE_ENDINGS = (*MESH_ENDINGS, ".stl")  # STL has neither colours nor joined vertices


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """Holds a mesh in its file's own unit, with its texture if it has one. Vertices are repeated along seams."""

    mesh: Mesh
    uv: Float[np.ndarray, "v 2"] | None = None  # of the vertices, v upwards
    image: ImageRgb | None = None


def read_mesh(path: Path, endings: tuple[str, ...] = MESH_ENDINGS) -> Mesh:
    """Reads PLY, OBJ, GLB or what else ``endings`` names, in the file's own units. Raises InputError."""
    return _mesh(_loaded(path, endings), path)


def read_textured_mesh(path: Path) -> TexturedMesh:
    """Reads PLY, OBJ or GLB with its texture. A texture that cannot be read is left out. Raises InputError."""
    loaded = _loaded(path)
    mesh, visual = _mesh(loaded, path), loaded.visual
    if visual is None or visual.kind != "texture" or visual.uv is None or len(visual.uv) != len(mesh.vertices):
        return TexturedMesh(mesh)
    picture = getattr(visual.material, "baseColorTexture", None) or getattr(visual.material, "image", None)
    uv = np.asarray(visual.uv, float)
    if picture is None or not np.isfinite(uv).all():
        return TexturedMesh(mesh)
    return TexturedMesh(mesh, uv, np.ascontiguousarray(np.asarray(picture.convert("RGB"), np.uint8)))


def _loaded(path: Path, endings: tuple[str, ...] = MESH_ENDINGS) -> Any:
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it would write to the user's terminal
    if path.suffix.lower() not in endings:
        raise InputError(path.name, [compose("no-mesh-ending" if endings == MESH_ENDINGS else "no-surface-ending")])
    plain = _plain_glb(path) if path.suffix.lower() == ".glb" else None
    source, kind = (path, None) if plain is None else (io.BytesIO(plain), "glb")
    try:
        loaded = trimesh.load(source, file_type=kind, force="mesh", process=False)
    except Exception as error:  # trimesh lets the parsers' own errors through, of any class
        raise InputError(path.name, [compose("mesh-unread", reason=str(error))]) from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(path.name, [compose("no-triangles")])
    return loaded


def _plain_glb(path: Path) -> bytes:
    """Returns a GLB without normalised integers and sparse accessors in its geometry. Raises InputError for a damaged
    one, and for required extensions that nobody here decodes."""
    data = path.read_bytes()
    try:
        (length,) = struct.unpack_from("<I", data, 12)
        document, payload = json.loads(data[20 : 20 + length]), bytearray(data[28 + length :])
        needed = [name for name in document.get("extensionsRequired", ()) if not name.startswith(UNDERSTOOD)]
        if needed:
            raise InputError(
                path.name, [compose("glb-extensions-unread", extensions=[_called(name) for name in needed])]
            )
        accessors = document.get("accessors", [])
        geometry = set()
        for primitive in (each for mesh in document.get("meshes", ()) for each in mesh["primitives"]):
            attributes = primitive["attributes"]
            geometry |= {attributes[key] for key in ("POSITION", "NORMAL", "TEXCOORD_0") if key in attributes}
            geometry |= {primitive["indices"]} if "indices" in primitive else set()
        odd = [accessors[i] for i in geometry if accessors[i].get("normalized") or "sparse" in accessors[i]]
        if not odd:
            return data
        for accessor in odd:
            values = _accessor_values(document, payload, accessor)
            document.setdefault("bufferViews", [])
            view = appended_view(document, payload, values)
            for key in ("normalized", "sparse", "byteOffset", "min", "max"):
                accessor.pop(key, None)
            accessor |= {"bufferView": view, "componentType": 5126 if values.dtype.kind == "f" else 5125}
        return closed_glb(document, payload)
    except (struct.error, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise InputError(path.name, [compose("mesh-unread", reason=f"no glTF 2.0, {type(error).__name__}")]) from error


def _called(extension: str) -> str:
    return f"{COMPRESSIONS[extension]} ({extension})" if extension in COMPRESSIONS else extension


def _accessor_values(document: Mapping[str, Any], payload: bytearray, accessor: Mapping[str, Any]) -> np.ndarray:
    """Returns the values of an accessor as 32-bit floats, of indices as whole numbers."""
    kind, width, count = KINDS[accessor["componentType"]], WIDTHS[accessor["type"]], accessor["count"]
    values = np.zeros((count, width), kind)
    if "bufferView" in accessor:
        values = _viewed(document, payload, accessor, (count, width), kind)
    if sparse := accessor.get("sparse"):
        changed, shape = sparse["indices"], (sparse["count"], width)
        at = _viewed(document, payload, changed, (sparse["count"], 1), KINDS[changed["componentType"]])
        values[at.ravel()] = _viewed(document, payload, sparse["values"], shape, kind)
    if accessor.get("normalized"):
        return np.maximum(values / np.float32(np.iinfo(kind).max), -1.0).astype("<f4")
    return values.astype("<f4" if width > 1 or kind == "<f4" else "<u4")


def _viewed(
    document: Mapping[str, Any], payload: bytearray, part: Mapping[str, Any], shape: tuple[int, int], kind: str
) -> np.ndarray:
    """Returns a copy of the rows of a part of the buffer, which may lie apart."""
    view, row = document["bufferViews"][part["bufferView"]], shape[1] * np.dtype(kind).itemsize
    start = view.get("byteOffset", 0) + part.get("byteOffset", 0)
    strides = (view.get("byteStride", row), np.dtype(kind).itemsize)
    return np.ndarray(shape, kind, buffer=payload, offset=start, strides=strides).copy()


def _mesh(loaded: Any, path: Path) -> Mesh:
    vertices = np.asarray(loaded.vertices, dtype=float)
    if not np.isfinite(vertices).all():
        raise InputError(path.name, [compose("vertex-not-finite")])
    if not np.ptp(vertices, axis=0).any() or not 0 <= np.min(loaded.faces) <= np.max(loaded.faces) < len(vertices):
        raise InputError(path.name, [compose("mesh-without-extent", count=len(vertices))])
    coloured = loaded.visual is not None and loaded.visual.kind == "vertex"
    visual = getattr(loaded.visual, "vertex_colors", None) if coloured else None
    colours = None if visual is None else np.ascontiguousarray(np.asarray(visual)[:, :3].astype(np.uint8))
    return Mesh(vertices, np.asarray(loaded.faces, dtype=np.int32), colours)

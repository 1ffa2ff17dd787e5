"""Reads meshes of other programs through the library trimesh: PLY, OBJ, GLB and, on request, STL.

trimesh ignores glTF's normalised integers, sparse accessors and compressions without an error. A GLB file with such
integers, accessors or compression is refused, and the message names the feature
(https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6.2, 3.12).
"""

import json
import logging
import re
import struct
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.text import as_utf8

MESH_ENDINGS = (".ply", ".obj", ".glb")
UNDERSTOOD = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_materials_", "KHR_lights_")
UNDECODED = {
    **{"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshopt"},
    **{"normalized": "quantised numbers", "sparse": "sparse accessors"},
}
SURFACE_ENDINGS = (*MESH_ENDINGS, ".stl")  # STL has neither colours nor joined vertices


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """Holds a mesh in the unit of its file, with an optional texture. Mesh vertices are repeated along seams."""

    mesh: Mesh
    uv: Float[np.ndarray, "v 2"] | None = None  # of the vertices, v upwards
    image: ImageRgb | None = None


def read_mesh(path: Path, endings: tuple[str, ...] = MESH_ENDINGS) -> Mesh:
    """Reads a mesh in one of the formats ``endings``, in the unit of the file. Raises InputError."""
    return _mesh(_loaded(path, endings), path)


def read_textured_mesh(path: Path) -> TexturedMesh:
    """Reads a PLY, OBJ or GLB file with its texture. Omits an unreadable texture. Raises InputError."""
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
    from trimesh.resolvers import FilePathResolver

    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it would write to the user's terminal
    if path.suffix.lower() not in endings:
        raise InputError(path.name, [compose("no-mesh-ending" if endings == MESH_ENDINGS else "no-surface-ending")])
    try:
        path.open("rb").close()
    except OSError as error:
        raise InputError(path.name, [compose("no-file-read", reason=error.strerror or str(error))]) from error
    if path.suffix.lower() == ".glb":
        _check_glb(path)
    try:
        if path.suffix.lower() == ".obj":
            text, beside = _plain_obj(path), FilePathResolver(str(path))
            loaded = trimesh.load(text, file_type="obj", resolver=beside, force="mesh", process=False)
        else:
            loaded = trimesh.load(path, force="mesh", process=False)
    except InputError:
        raise
    except Exception as error:  # trimesh lets the parsers' own errors through, of any class
        reason = compose("mesh-cut-off", kind=path.suffix[1:].upper())
        raise InputError(path.name, [compose("mesh-unread", reason=reason)]) from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(path.name, [compose("no-triangles")])
    return loaded


def _plain_obj(path: Path) -> StringIO:
    """Removes from an OBJ file all that trimesh misreads: a byte order mark, old line ends, tabs, and comments after
    numbers. Raises InputError if face indices start at 0, because trimesh would take 0 for the last vertex."""
    text = as_utf8(path.read_bytes()).decode("utf-8", "replace")
    text = re.sub(r"\r\n?", "\n", text).replace("\t", " ")
    text = re.sub(r"^((?:v|vt|vn|f) [^#\n]*)#.*", r"\1", text, flags=re.MULTILINE)
    if re.search(r"^f .*(?<![\d/])0(?!\d)", text, re.MULTILINE):
        raise InputError(path.name, [compose("mesh-unread", reason=compose("faces-from-zero"))])
    return StringIO(text)


def _check_glb(path: Path) -> None:
    """Raises InputError for a damaged GLB file or data in encodings that trimesh does not decode."""
    data = path.read_bytes()
    try:
        (length,) = struct.unpack_from("<I", data, 12)
        document = json.loads(data[20 : 20 + length])
        accessors, unread = document.get("accessors", []), set[str]()
        unread |= {name for name in document.get("extensionsRequired", ()) if not name.startswith(UNDERSTOOD)}
        for primitive in (each for mesh in document.get("meshes", ()) for each in mesh["primitives"]):
            attributes = primitive["attributes"]
            geometry = [attributes[key] for key in ("POSITION", "NORMAL", "TEXCOORD_0") if key in attributes]
            for accessor in [
                accessors[i] for i in (*geometry, *([primitive["indices"]] if "indices" in primitive else []))
            ]:
                unread |= {key for key in ("normalized", "sparse") if accessor.get(key)}
                unread |= set() if "bufferView" in accessor else {*primitive.get("extensions", ())}
    except (struct.error, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise InputError(path.name, [compose("mesh-unread", reason=f"no glTF 2.0, {type(error).__name__}")]) from error
    if unread:
        raise InputError(
            path.name, [compose("glb-extensions-unread", extensions=[_called(name) for name in sorted(unread)])]
        )


def _called(what: str) -> str:
    return f"{UNDECODED[what]} ({what})" if what in UNDECODED else what


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

"""Reads and writes PLY files with the vertex properties of docs/capture-format.md. The library trimesh is not used,
because it lacks these properties and its output differs between versions."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from rig.errors import InputError
from rig.files import write_atomically
from rig.mesh import Mesh
from rig.messages.message import compose

PLY_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    + [(name, "u1") for name in ("red", "green", "blue")]
    + [("quality", "<f4"), ("views", "u1")]
)
PLY_PART_VERTEX = np.dtype([*PLY_VERTEX.descr, ("part", "u1")])
PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
PLY_TEXTURED_FACE = np.dtype([*PLY_FACE.descr, ("numbers", "u1"), ("texcoord", "<f4", 6)])
PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def ply_bytes(
    mesh: Mesh,
    *,
    normals: Float[np.ndarray, "v 3"],
    colours: UInt8[np.ndarray, "v 3"],
    quality: Float[np.ndarray, " v"],
    views: UInt8[np.ndarray, " v"],
    part: UInt8[np.ndarray, " v"] | None = None,
    corner_uv: Float[np.ndarray, "f 3 2"] | None = None,
    comments: Sequence[str] = (),
) -> bytes:
    """Encodes a surface (mm) as binary little-endian PLY with unit normals and sRGB colours. ``quality`` is the
    standard deviation of each vertex along its normal (mm), ``views`` the number of images that coloured it, and
    ``part`` its label (skin, hair or clothes). ``corner_uv`` holds texture coordinates of the faces' corners with v
    downwards, written as MeshLab's ``texcoord`` with v upwards. ``comments`` are lines of the PLY header."""
    kind = PLY_VERTEX if part is None else PLY_PART_VERTEX
    vertices = np.empty(len(mesh.vertices), kind)
    for i, axis in enumerate("xyz"):
        vertices[axis] = mesh.vertices[:, i]
        vertices["n" + axis] = normals[:, i]
    for i, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = colours[:, i]
    vertices["quality"], vertices["views"] = quality, views
    if part is not None:
        vertices["part"] = part
    faces = np.empty(len(mesh.faces), PLY_FACE if corner_uv is None else PLY_TEXTURED_FACE)
    faces["count"], faces["corners"] = 3, mesh.faces
    if corner_uv is not None:
        faces["numbers"], faces["texcoord"] = 6, (corner_uv * (1, -1) + (0, 1)).reshape(-1, 6)
    properties = [f"property {PLY_TYPES[kind[name].str]} {name}" for name in kind.names or ()]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        *([] if corner_uv is None else ["property list uchar float texcoord"]),
        "end_header",
        "",
    ]
    return "\n".join(header).encode("ascii") + vertices.tobytes() + faces.tobytes()


def write_ply(path: Path, mesh: Mesh, **properties: Any) -> None:
    """Writes the result of ``ply_bytes`` to a file atomically."""
    write_atomically(path, ply_bytes(mesh, **properties))


def read_head_ply(path: Path) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """Reads a head.ply file of this project. Returns the mesh (mm, world frame) and each vertex's standard deviation
    (mm) along its normal.

    Raises InputError for a truncated file or a file of another program."""
    vertices, faces = _head_rows(path)
    places = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(float)
    colours = np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=1)
    return Mesh(places, faces.astype(np.int32), colours), vertices["quality"].astype(float)


def read_view_counts(path: Path) -> UInt8[np.ndarray, " v"]:
    """Reads the number of images that coloured each vertex of a head.ply, 0 if interpolated. Raises InputError."""
    return _head_rows(path)[0]["views"].copy()


def read_vertex_numbers(path: Path, name: str) -> Float[np.ndarray, " v"] | None:
    """Reads the property ``name`` of each vertex from a file by ``write_ply``. Returns None if the file lacks the
    property. Raises InputError for a file of another program."""
    vertices, _ = _head_rows(path)
    return vertices[name].astype(np.float32) if name in (vertices.dtype.names or ()) else None


def _head_rows(path: Path) -> tuple[np.ndarray, Int[np.ndarray, "f 3"]]:
    """Reads the vertex records (``PLY_VERTEX`` or ``PLY_PART_VERTEX``) and the faces. Raises InputError."""
    try:
        header, end, body = path.read_bytes().partition(b"end_header\n")
    except OSError as error:
        raise InputError(path.name, [compose("no-file-read", reason=str(error.strerror or error))]) from error
    lines = header.decode("ascii", "replace").splitlines()
    counts = [int(line.split()[2]) for line in lines if re.fullmatch(r"element (vertex|face) \d{1,9}", line)]
    names = [line.split()[-1] for line in lines if line.startswith("property") and "list" not in line]
    vertex = PLY_PART_VERTEX if names[-1:] == ["part"] else PLY_VERTEX
    ours = end and "format binary_little_endian 1.0" in lines and names == list(vertex.names or ())
    if not ours or len(counts) != 2:
        raise InputError(path.name, [compose("no-head-ply")])
    face = PLY_TEXTURED_FACE if "property list uchar float texcoord" in lines else PLY_FACE
    wanted = counts[0] * vertex.itemsize + counts[1] * face.itemsize
    if len(body) != wanted:
        raise InputError(path.name, [compose("ply-bytes", held=len(body), wanted=wanted)])
    vertices = np.frombuffer(body, vertex, counts[0])
    faces = np.frombuffer(body, face, counts[1], counts[0] * vertex.itemsize)["corners"]
    return vertices, faces

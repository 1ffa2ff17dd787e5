"""Reads raw scans and their landmarks: a mesh file (PLY, OBJ, GLB) and a landmark file of the same name beside it.

Landmark files are ``.json`` (``{"points": {"pronasale": [x, y, z]}}``, or the names at the top level), MeshLab's picked
points ``.pp``, landmarker.io's ``.ljson`` (versions 1 to 3; a label with a single point is a landmark), and 3D Slicer's
``.mrk.json``. Landmark names are the 26 in landmarks.py, in any case and with blanks or hyphens."""

import json
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.head_model.landmarks import NAMES
from rig.errors import InputError
from rig.formats.meshes.markups import Axes, read_markups
from rig.formats.meshes.mesh_file import read_mesh
from rig.mesh import Mesh

MESH_SUFFIXES = (".ply", ".obj", ".glb")
LANDMARK_SUFFIXES = (".json", ".mrk.json", ".pp", ".ljson")


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Holds one head as a scanner delivers it: any number of vertices, possibly with holes, in the scanner's frame. The
    scan's landmarks are in the frame of its vertices."""

    name: str
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    landmarks: Mapping[str, Float[np.ndarray, " 3"]]


def find_scans(folder: Path) -> list[Path]:
    """Returns the mesh files of a folder, sorted by name. Raises InputError if there are no mesh files, or several for
    one head."""
    found = sorted(p for p in folder.glob("*") if p.suffix.lower() in MESH_SUFFIXES) if folder.is_dir() else []
    if not found:
        raise InputError(str(folder), ["holds no .ply, .obj or .glb scans (for results of jobs give --from-results)"])
    stems = Counter(path.stem for path in found)
    twice = [f"holds more than one scan called {name}: keep one" for name, count in stems.items() if count > 1]
    if twice:
        raise InputError(str(folder), twice)
    return found


def read_scan(path: Path) -> Scan:
    """Returns a scan with its landmarks. Raises InputError if the scan's files cannot be used."""
    mesh, _ = weld_scan(read_mesh(path))
    landmarks_path = landmark_file(path)
    if landmarks_path is None:
        beside = ", ".join(path.with_suffix(suffix).name for suffix in LANDMARK_SUFFIXES)
        raise InputError(path.name, [f"has no landmarks beside it ({beside})"])
    return Scan(path.stem, mesh.vertices, mesh.faces, read_landmarks(landmarks_path))


def landmark_file(mesh: Path) -> Path | None:
    """Returns the landmark file that belongs to a mesh file, or None."""
    beside = (mesh.with_suffix(suffix) for suffix in LANDMARK_SUFFIXES)
    return next((path for path in beside if path.is_file()), None)


def weld_scan(mesh: Mesh) -> tuple[Mesh, Bool[np.ndarray, " F"]]:
    """Returns the mesh with each position stored once, without unused vertices, colours and degenerate triangles; also
    a mask of the triangles that remain.

    Mesh files repeat vertices along texture seams or for each triangle. A mesh torn along seams lacks the neighbours
    that are needed to smooth noise."""
    _, first, index = np.unique(mesh.vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    corners = index.ravel()[mesh.faces]
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    used, faces = np.unique(corners[proper], return_inverse=True)
    return Mesh(mesh.vertices[first[used]], faces.reshape(-1, 3).astype(np.int32)), proper


def read_landmarks(path: Path, axes: Axes = "LPS") -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns landmarks by this project's names; other points in the file are ignored. A .mrk.json file states its own
    axes and is converted to ``axes``. Raises InputError if the landmark file cannot be used."""
    readers = {".json": _from_json, ".pp": _from_pp, ".ljson": _from_ljson}
    try:
        is_list = path.name.lower().endswith(".mrk.json")
        read = readers[path.suffix.lower()]
        named = read_markups(path, axes) if is_list else read(path.read_text(encoding="utf-8-sig"))
        points = {plain_name(name): np.array(point, float) for name, point in named.items()}
    except (ValueError, KeyError, TypeError, AttributeError, ElementTree.ParseError) as fault:
        raise InputError(
            path.name, [f"is no landmark file that can be read ({type(fault).__name__}: {fault})"]
        ) from None
    known = {name: point for name, point in points.items() if name in NAMES}
    if not known:
        listed = ", ".join(sorted(points)[:8]) or "nothing"
        raise InputError(path.name, [f"names none of the 26 landmarks ({', '.join(NAMES[:3])}, ...) but {listed}"])
    bad = [name for name, point in known.items() if point.shape != (3,) or not np.isfinite(point).all()]
    if bad:
        raise InputError(path.name, [f"{name} is no point of three finite numbers" for name in bad])
    return known


def plain_name(name: str) -> str:
    """Returns a landmark's name in lower case with underscores."""
    return "_".join(name.strip().lower().replace("-", " ").replace("_", " ").split())


def _from_json(text: str) -> Mapping[str, list[float]]:
    content = json.loads(text)
    return content.get("points", {k: v for k, v in content.items() if isinstance(v, list)})


def _from_pp(text: str) -> Mapping[str, list[float]]:
    root = ElementTree.fromstring(text)
    return {
        point.attrib["name"]: [float(point.attrib[axis]) for axis in "xyz"]
        for point in root.iter("point")
        if point.attrib.get("active", "1") != "0"
    }


def _from_ljson(text: str) -> Mapping[str, list[float]]:
    content = json.loads(text)
    if content["version"] == 1:
        groups = [(g["label"], [p["point"] for p in g["landmarks"]]) for g in content["groups"]]
        return {label: points[0] for label, points in groups if len(points) == 1}
    groups = [content] if content["version"] == 2 else list(content["groups"].values())
    out: dict[str, list[float]] = {}
    for group in groups:
        points = group["landmarks"]["points"]
        out |= {label["label"]: points[label["mask"][0]] for label in group["labels"] if len(label["mask"]) == 1}
    return out

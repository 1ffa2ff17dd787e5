"""Reads and writes Wavefront OBJ without changing vertex order, polygons, texture coordinates, groups and materials.

The module ``mesh_file`` uses trimesh, which splits polygons and may reorder vertices. Template meshes need the original
polygons and order."""

import io
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from rig.errors import InputError
from rig.formats.meshes.scene import Scene
from rig.messages.message import Message, compose

MATERIAL = "skin"
MOST_VERTICES = 200_000  # 8 times a film's head; registering it takes 4 minutes and 2 GB. Larger files are scans
MOST_CORNERS = 8 * MOST_VERTICES
MOST_SIDES = 4096  # of a polygon: ten times what closes a neck; a fan of all corners takes minutes to follow
MOST_BYTES = 256 << 20
FAULTS_TOLD = 12
KEPT_STATEMENTS = ("o", "g", "s", "usemtl")


@dataclass(frozen=True, slots=True, eq=False)
class PolygonMesh:
    """Holds a polygon mesh with the order of its file. The array ``corners`` concatenates the corners of all polygons.
    In the texture coordinates ``uv``, v points upwards."""

    vertices: Float[np.ndarray, "v 3"]
    sizes: Int[np.ndarray, " p"]  # corners of each polygon, 3 or more
    corners: Int[np.ndarray, " c"]  # vertex of each corner
    uv: Float[np.ndarray, "t 2"]
    corner_uv: Int[np.ndarray, " c"]  # row of ``uv``, -1 where a corner has none
    statements: tuple[tuple[int, str], ...] = ()  # groups and materials: before which polygon, and the line

    def triangles(self) -> Int[np.ndarray, "f 3"]:
        """Triangulates every polygon as a fan of triangles at its first corner."""
        return self.corners[triangulate_fan(self.sizes)]


def triangulate_fan(sizes: Int[np.ndarray, " p"]) -> Int[np.ndarray, "f 3"]:
    """Triangulates polygons with ``sizes`` corners each. Returns the rows of ``corners`` that form each triangle."""
    first = np.cumsum(sizes) - sizes
    count = sizes - 2
    owner = np.repeat(np.arange(len(sizes)), count)
    step = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    return np.stack([first[owner], first[owner] + step + 1, first[owner] + step + 2], axis=1)


def read_polygons(path: Path) -> PolygonMesh:
    """Reads an OBJ file, in the unit and the order of the file. Raises InputError naming every fault."""
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            large = compose("mesh-file-large", size_mb=size >> 20, most_mb=MOST_BYTES >> 20)
            raise InputError(path.name, [large])
        reading = _Reading()
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            for number, line in _whole_lines(file):
                reading.take(number, line)
                if reading.too_large():
                    break
    except OSError as error:
        raise InputError(path.name, [compose("no-file-read", reason=str(error.strerror or error))]) from None
    return reading.finished(path.name)


def _whole_lines(file: Iterable[str]) -> Iterable[tuple[int, str]]:
    """Yields lines with their numbers. Joins a line of OBJ that ends with a backslash with the next line."""
    begun = ""
    for number, raw in enumerate(file, start=1):
        line = raw.rstrip()
        if line.endswith("\\"):
            begun += line[:-1] + " "
            continue
        yield number, begun + line
        begun = ""
    if begun:
        yield 0, begun


@dataclass(slots=True)
class _Reading:
    """Collects the content of an OBJ file while reading it."""

    vertices: list[tuple[float, ...]] = field(default_factory=list)
    uv: list[tuple[float, ...]] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    corners: list[int] = field(default_factory=list)
    corner_uv: list[int] = field(default_factory=list)
    statements: list[tuple[int, str]] = field(default_factory=list)
    faults: list[Message] = field(default_factory=list)
    untold: int = 0  # faults beyond those

    def fault(self, make: Callable[[], Message]) -> None:
        if len(self.faults) < FAULTS_TOLD:
            self.faults.append(make())
        else:
            self.untold += 1

    def take(self, number: int, line: str) -> None:
        word, _, rest = line.strip().partition(" ")
        if word == "v":
            self.vertices.append(self._numbers(number, line, rest.split(), 3))
        elif word == "vt":
            self.uv.append(self._numbers(number, line, [*rest.split(), "0"], 2))  # v may be left out
        elif word == "f":
            self._face(number, line, rest.split(None, MOST_SIDES))
        elif word in KEPT_STATEMENTS:
            self.statements.append((len(self.sizes), f"{word} {rest.strip()}"))

    def _numbers(self, number: int, line: str, words: list[str], count: int) -> tuple[float, ...]:
        try:
            found = tuple(float(word) for word in words[:count])
        except ValueError:
            found = ()
        if len(found) == count and all(map(math.isfinite, found)):
            return found
        self.fault(lambda: compose("line-no-numbers", line=number, text=f"{line.strip()!r:.60}", wanted=count))
        return (0.0,) * count

    def _face(self, number: int, line: str, words: list[str]) -> None:
        if len(words) > MOST_SIDES:
            self.fault(lambda: compose("line-many-corners", line=number, most=MOST_SIDES))
            return
        try:
            named = [[int(part) if part else None for part in word.split("/")[:2]] for word in words]
        except ValueError:
            named = []
        if len(named) < 3:
            self.fault(lambda: compose("line-no-polygon", line=number, text=f"{line.strip()!r:.60}"))
            return
        for corner in named:
            self.corners.append(self._row(number, corner[0], len(self.vertices)))
            index = corner[1] if len(corner) > 1 else None
            self.corner_uv.append(-1 if index is None else self._row(number, index, len(self.uv)))
        self.sizes.append(len(named))

    def _row(self, number: int, index: int | None, count: int) -> int:
        """Converts an index of OBJ, which counts from 1 or backwards from -1, to a row number. OBJ indices beyond the
        ``count`` rows so far are checked at the end of the file."""
        row = -1 if index is None else index - 1 if index > 0 else count + index
        if not index or row < 0:
            self.fault(lambda: compose("line-strange-row", line=number, row=f"{index}"))
            return 0
        return row

    def too_large(self) -> bool:
        return len(self.vertices) > MOST_VERTICES or len(self.corners) > MOST_CORNERS or len(self.uv) > MOST_CORNERS

    def finished(self, name: str) -> PolygonMesh:
        """Returns the mesh after the end of the OBJ file. Raises InputError naming every fault."""
        faults = self.faults
        if self.untold:
            faults.append(compose("lines-more", more=self.untold))
        if self.too_large():
            large = compose("mesh-large", vertices=MOST_VERTICES, corners=MOST_CORNERS)
            raise InputError(name, [*faults, large])
        if not self.vertices:
            faults.append(compose("no-vertices"))
        if not self.sizes:
            faults.append(compose("no-faces"))
        corners, corner_uv = np.array(self.corners, np.int32), np.array(self.corner_uv, np.int32)
        for code, rows, count in (
            ("face-beyond-vertices", corners, len(self.vertices)),
            ("face-beyond-texture", corner_uv, len(self.uv)),
        ):
            if rows.size and rows.max() >= count and count:
                faults.append(compose(code, row=rows.max() + 1, held=count))
        if corner_uv.size and corner_uv.max() >= 0 and not self.uv:
            faults.append(compose("faces-without-texture"))
        if faults:
            raise InputError(name, faults)
        uv = np.array(self.uv, float).reshape(-1, 2)
        return PolygonMesh(
            np.array(self.vertices), np.array(self.sizes, np.int32), corners, uv, corner_uv, tuple(self.statements)
        )


def polygon_obj_bytes(
    mesh: PolygonMesh,
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    *,
    colours: UInt8[np.ndarray, "v 3"] | None = None,
    comments: Iterable[str] = (),
    library: str | None = None,
    decimals: int = 4,
) -> bytes:
    """Encodes ``mesh`` as OBJ with the vertex positions ``vertices``. sRGB colours follow the position on a line, as
    MeshLab and Blender expect. ``comments`` are lines at the top of the OBJ file. ``library`` is the name of an .mtl
    file in the same folder. ``decimals`` applies to positions."""
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in comments)
    position = " ".join([f"%.{decimals}f"] * 3)
    if library:
        text.write(f"mtllib {library}\n")
    if colours is None:
        np.savetxt(text, vertices, fmt=f"v {position}")
    else:
        rows = np.concatenate([vertices, colours / 255.0], axis=1)
        np.savetxt(text, rows, fmt=f"v {position} %.4f %.4f %.4f")
    np.savetxt(text, mesh.uv, fmt="vt %.6f %.6f")
    np.savetxt(text, normals, fmt="vn %.4f %.4f %.4f")
    _write_faces(text, mesh)
    return text.getvalue().encode()


def _write_faces(text: io.StringIO, mesh: PolygonMesh) -> None:
    named = [f"{v}/{t}/{v}" if t else f"{v}//{v}" for v, t in zip(mesh.corners + 1, mesh.corner_uv + 1, strict=True)]
    ends = np.cumsum(mesh.sizes).tolist()
    lines = [
        "f " + " ".join(named[end - size : end]) + "\n" for end, size in zip(ends, mesh.sizes.tolist(), strict=True)
    ]
    written = 0
    for before, statement in mesh.statements:
        text.writelines(lines[written:before])
        written = before
        text.write(statement + "\n")
    text.writelines(lines[written:])


def scene_obj_bytes(scene: Scene, library: str | None = None) -> bytes:
    """Encodes a scene's parts as objects of a Wavefront OBJ in millimetres, with the scene's rotations applied.

    Only texture coordinates, not vertices, are doubled at seams. If a part has no texture, its sRGB vertex colours
    follow the positions. ``library`` is the name of the .mtl file.
    """
    text, first, first_uv, first_normal = io.StringIO(), 1, 1, 1
    if library is not None:
        text.write(f"mtllib {library}\n")
    for part in scene.parts:
        about, place = scene.about(part)
        vertices, skin = place.apply(about), part.skin
        text.write(f"o {part.name}\n")
        if skin is None:
            colours = np.full(vertices.shape, 200, np.uint8) if part.mesh.colours is None else part.mesh.colours
            coloured = np.concatenate([vertices, colours / 255.0], axis=1)
            np.savetxt(text, coloured, fmt="v %.4f %.4f %.4f %.4f %.4f %.4f")
            np.savetxt(text, part.mesh.faces + first, fmt="f %d %d %d")
        else:
            text.write(f"usemtl {MATERIAL}\n")
            np.savetxt(text, vertices, fmt="v %.4f %.4f %.4f")
            np.savetxt(text, skin.uv * (1, -1) + (0, 1), fmt="vt %.6f %.6f")  # OBJ's v is upwards
            np.savetxt(text, part.unit_normals() @ place.rotation.T, fmt="vn %.4f %.4f %.4f")
            faces_uv = part.mesh.faces if skin.faces is None else skin.faces
            corners = [part.mesh.faces + first, faces_uv + first_uv, part.mesh.faces + first_normal]
            np.savetxt(text, np.stack(corners, axis=2).reshape(-1, 9), fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
            first_uv, first_normal = first_uv + len(skin.uv), first_normal + len(vertices)
        first += len(vertices)
    return text.getvalue().encode()


def mtl_bytes(image: str) -> bytes:
    """Returns the .mtl file for a textured part. ``image`` is the texture's file name in the same folder."""
    lines = ("newmtl skin", "Ka 1 1 1", "Kd 1 1 1", "Ks 0.04 0.04 0.04", "Ns 20", "illum 2", f"map_Kd {image}", "")
    return "\n".join(lines).encode()

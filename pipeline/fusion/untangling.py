"""Repairs a mesh so that no triangle is flipped, folded onto its neighbour, or intersects another triangle.

Expressions and other displacements can make closed lips intersect, fold closing lids behind the brow, or push an ear
into the head. Each bad region, if necessary with rings of triangles around it, first gets the shape of the model's mean
head, which has no bad triangles. The region's displacement from the mean head is interpolated from the region's border,
so that an ear remains an ear. Regions that are still bad become smooth surfaces through their border (membranes). All
vertices outside bad regions stay unchanged."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int

from pipeline.compute.array_cache import cached_arrays
from pipeline.estimation.positive_definite import factorised
from pipeline.fusion.crossing_kernels import any_corner, turned_and_folded
from pipeline.fusion.crossings import crossing_faces
from pipeline.fusion.grid_kernels import component_of
from pipeline.geometry.registration.rigid import procrustes
from pipeline.head_model.model import HeadModel
from rig.mesh import Mesh

MAX_FOLD_DEG = 100.0  # between the normals of triangles that share an edge
RINGS = (1, 1, 2, 3, 4, 6, 8, 11, 15, 20, 26, 33, 41, 50)  # about a spot that was spoilt so many times; heads of random
# shapes and expressions need 5 to 8 of them
REST_RINGS = (1, 2, 3, 5)  # the same while spots get the mean head's shape. Larger ones move more vertices, and those
# that are not clean by then seldom are later (tests/laboratory/notes/meshes.md)
SMALL_RINGS = (1, 2, 3)  # about spots of a fused surface: a larger membrane would cut off an ear
HALVINGS = 2  # rounds in which vertices go half their way to safe places; in later ones they go all of it
PLACED_BY = 32  # every so-many-th vertex places the mean head; of so few, BLAS sums alike with any number of threads
ENCLOSED_SHARE = 0.04  # of the vertices: a smaller piece that spoilt triangles cut off is a part of their loop or lens
Vertices = Float[np.ndarray, "v 3"]
Faces = Int[np.ndarray, "f 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """Holds a mesh's triangles, the pairs of triangles that share an edge (``pairs``), and the sparse adjacency matrix
    of the vertices (``beside``)."""

    faces: Faces
    pairs: Int[np.ndarray, "e 2"]
    beside: sparse.csr_array  # (v, v)


@dataclass(frozen=True, slots=True)
class MeshFaults:
    """Counts the bad triangles and edges of a mesh.

    Attributes:
        turned: triangles that face against the mean normal of their corners.
        folded: edges whose triangles' normals are more than ``MAX_FOLD_DEG`` apart.
        crossing: triangles that intersect another triangle other than a neighbour over an edge.
    """

    turned: int
    folded: int
    crossing: int


CLEAN = MeshFaults(turned=0, folded=0, crossing=0)


def topology_of(faces: Faces, count: int) -> Topology:
    """Returns the topology of a mesh with ``count`` vertices."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    key, owner = ends[:, 0] * count + ends[:, 1], np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(key, kind="stable")
    key = key[order]
    repeated = key[1:] == key[:-1]
    same = np.flatnonzero(repeated)
    low, high = np.divmod(key[np.append(True, ~repeated)], count)
    columns = (np.concatenate([low, high]), np.concatenate([high, low]))
    beside = sparse.csr_array((np.ones(2 * len(low)), columns), shape=(count, count))
    return Topology(faces, np.stack([owner[order][same], owner[order][same + 1]], axis=1), beside)


@lru_cache(maxsize=2)  # models are few, jobs are many
def head_topology(model: HeadModel) -> Topology:
    """Returns the topology of a head model's full mesh."""
    return topology_of(model.levels["full"].faces, model.levels["full"].count)


def untangle_head(
    model: HeadModel, vertices: Vertices, deviation_mm: Float[np.ndarray, " v"]
) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """Repairs the head's bad triangles. Returns the vertices, and their standard deviations enlarged by the distances
    moved.

    ``model``: the head model. ``vertices``: full mesh, mm. ``deviation_mm``: standard deviation of each vertex.
    """
    clean = untangle(vertices, head_topology(model), clean_mean_head(model))
    moved_mm = np.linalg.norm(clean - vertices, axis=1)
    return Mesh(clean, model.levels["full"].faces), np.hypot(deviation_mm, moved_mm)


@lru_cache(maxsize=2)
def clean_mean_head(model: HeadModel) -> Vertices:
    """Returns the full mesh of the model's mean head (head frame, mm) without bad triangles."""

    def make() -> dict[str, np.ndarray]:
        return {"vertices": untangle(model.vertices(np.zeros(0)), head_topology(model))}

    inputs = (model.mean, model.levels["full"].faces)
    return cached_arrays("clean-mean-head", inputs, make, made_by=(crossing_faces, component_of, HeadModel))["vertices"]


def untangle(vertices: Vertices, topology: Topology, rest: Vertices | None = None) -> Vertices:
    """Repairs all bad regions of a mesh. The repaired mesh is tested in single precision, as files store it.

    Args:
        vertices: mm.
        topology: of the mesh.
        rest: a shape of the same mesh without bad triangles, in any frame and scale, which is tried first for each bad
            region. None replaces all bad regions by membranes.
    """
    out = vertices.astype(np.float32, order="C").astype(float)
    spoilt, touched = spoilt_faces(out, topology), np.zeros(len(out), bool)
    if spoilt.any() and rest is not None:
        placed = procrustes(rest[::PLACED_BY], out[::PLACED_BY]).apply(rest)
        out, spoilt, spot = _mended(out, spoilt, topology, placed, REST_RINGS)
        touched |= spot
    out, spoilt, spot = _mended(out, spoilt, topology, np.zeros_like(out), RINGS)
    return np.where((touched | spot)[:, None], out, vertices)


def smooth_spots(vertices: Vertices, topology: Topology, safe: Vertices) -> Vertices:
    """Repairs the bad regions of a fused surface (mm), tested in single precision. Small regions become membranes;
    where thin sheets would collapse, vertices move to the positions ``safe``, at which the whole mesh is free of
    faults."""
    out = vertices.astype(np.float32, order="C").astype(float)
    spoilt, flat = spoilt_faces(out, topology), np.zeros_like(out)
    out, spoilt, touched = _mended(out, spoilt, topology, flat, SMALL_RINGS, enclosing=False)
    halvings, safe = HALVINGS, safe.astype(np.float32)
    while spoilt.any():  # with all triangles about it at the safe places, a triangle is clean: each round adds some
        near = np.zeros(len(out), bool)
        near[topology.faces[_around(spoilt, topology.faces, len(out))]] = True
        share = 0.5 if halvings > 0 else 0.0
        out[near] = (safe[near] + share * (out[near] - safe[near])).astype(np.float32)
        spoilt, halvings, touched = spoilt_faces(out, topology, near), halvings - 1, touched | near
    return np.where(touched[:, None], out, vertices)


def _mended(
    vertices: Vertices,
    spoilt: Bool[np.ndarray, " f"],
    topology: Topology,
    shape: Vertices,
    rings: tuple[int, ...],
    *,
    enclosing: bool = True,
) -> tuple[Vertices, Bool[np.ndarray, " f"], Bool[np.ndarray, " v"]]:
    """Replaces bad regions by ``shape``, displaced like their border, in ``len(rings)`` rounds; ``rings`` is the number
    of rings added in each round. Returns the vertices in single precision, a mask of the remaining bad triangles, and a
    mask of the moved vertices. ``enclosing`` adds small pieces of the mesh that a region cuts off."""
    out, times, touched = vertices.copy(), np.zeros(len(vertices), int), np.zeros(len(vertices), bool)
    while spoilt.any() and times.max() < len(rings):
        times[np.unique(topology.faces[spoilt])] += 1
        spot = _with_rings(times, spoilt, topology.faces, rings)
        if enclosing:
            spot = _with_enclosed(spot, topology.faces)
        if spot.all():
            break
        rows = np.flatnonzero(spot)
        out[rows] = (shape[rows] + _membrane(out - shape, rows, topology)).astype(np.float32)
        touched |= spot
        spoilt = spoilt_faces(out, topology, spot)
    return out, spoilt, touched


def spoilt_faces(
    vertices: Vertices, topology: Topology, within: Bool[np.ndarray, " v"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Returns a mask of triangles that are flipped, folded onto a neighbour, or intersect another triangle. ``within``:
    tests only triangles with a corner among these vertices, and their neighbours; None tests all."""
    active = None if within is None else any_corner(within, topology.faces)
    return turned_faces(vertices, topology, active) | crossing_faces(vertices, topology.faces, active)


def turned_faces(
    vertices: Vertices, topology: Topology, active: Bool[np.ndarray, " f"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Returns a mask of triangles that face against the mean normal of their corners, or are folded by more than
    ``MAX_FOLD_DEG`` against a neighbour. ``active``: tests only these triangles and their neighbours; None tests
    all."""
    faces, count = topology.faces, len(vertices)
    near = np.ones(len(faces), bool) if active is None else _around(_around(active, faces, count), faces, count)
    turned, folded = _turned_and_folded(vertices, topology, near)
    turned[folded] = True
    # At the border of what was looked at, means lack triangles.
    return turned if active is None else turned & _around(active, faces, count)


def mesh_faults(vertices: Vertices, topology: Topology, moved: Bool[np.ndarray, " v"] | None = None) -> MeshFaults:
    """Counts the faults of a mesh, also those that the model's mean head has. ``moved``: tests only triangles at these
    vertices for intersections; None tests all."""
    active = None if moved is None else any_corner(moved, topology.faces)
    turned, folded = _turned_and_folded(vertices, topology, np.ones(len(topology.faces), bool))
    return MeshFaults(int(turned.sum()), len(folded), int(crossing_faces(vertices, topology.faces, active).sum()))


def _turned_and_folded(
    vertices: Vertices, topology: Topology, near: Bool[np.ndarray, " f"]
) -> tuple[Bool[np.ndarray, " f"], Int[np.ndarray, "e 2"]]:
    """Returns a mask of triangles that face against the mean normal of their corners, and the pairs of triangles that
    are folded at their common edge. Only triangles in ``near`` are tested."""
    args = vertices, topology.faces, topology.pairs, near, np.cos(np.radians(MAX_FOLD_DEG))
    turned, folded = turned_and_folded(*args)
    return turned, topology.pairs[folded]


def _around(chosen: Bool[np.ndarray, " f"], faces: Faces, count: int) -> Bool[np.ndarray, " f"]:
    """Returns a mask of the chosen triangles and of triangles that share a corner with them."""
    corner = np.zeros(count, bool)
    corner[faces[chosen]] = True
    return any_corner(corner, faces)


def _with_rings(
    times: Int[np.ndarray, " v"], spoilt: Bool[np.ndarray, " f"], faces: Faces, rings: tuple[int, ...]
) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the vertices of all bad regions: the corners of bad triangles and ``rings`` of triangles around
    them. The number of rings grows with the number of repairs at a corner."""
    spot, reach = np.unique(faces[spoilt]), np.zeros(len(times), int)
    reach[spot] = 1 + np.array(rings)[np.minimum(times[spot], len(rings)) - 1]
    for _ in range(int(reach.max()) - 1):
        part = faces[any_corner(reach > 1, faces)]
        np.maximum.at(reach, part.ravel(), np.repeat(reach[part].max(axis=1) - 1, 3))
    return reach > 0


def _with_enclosed(spot: Bool[np.ndarray, " v"], faces: Faces) -> Bool[np.ndarray, " v"]:
    """Adds to a region the small pieces of the mesh that the region separates from the rest."""
    piece = component_of(faces[~any_corner(spot, faces)].astype(np.int32, copy=False), len(spot))
    size = np.bincount(piece[~spot], minlength=len(spot))
    return spot | (size[piece] < ENCLOSED_SHARE * len(spot))


def _membrane(vertices: Vertices, rows: Int[np.ndarray, " r"], topology: Topology) -> Float[np.ndarray, "r 3"]:
    """Returns positions of the vertices ``rows`` at which each is the mean of its neighbours, with all other vertices
    fixed."""
    beside, free = topology.beside[rows], np.zeros(len(vertices), bool)
    free[rows] = True
    count = np.asarray(beside.sum(axis=1)).ravel()
    matrix = sparse.csc_array(sparse.diags_array(count) - beside[:, rows])
    return factorised(matrix).solve(beside @ np.where(free[:, None], 0.0, vertices))

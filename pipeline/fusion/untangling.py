"""Repairs a head's mesh so that no triangle is turned over, folded onto its neighbour, or passes through another.

Expressions, kernel modes and displacements move vertices one by one, regardless of the surface: closed lips pass
through each other, lids that close fold behind the brow, an ear sinks into the head. Each such spot, if need be with
rings of triangles about it, first gets the shape of the model's clean mean head: the displacement from it is replaced
by the membrane through the displacements about the spot, so that an ear remains an ear. Spots that are still not clean
become membranes themselves: loops shrink to nothing, and two sheets that went through each other separate. All other
vertices stay where they are."""

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
    """Holds a mesh's triangles, the pairs of triangles that share an edge (``pairs``), and a sparse matrix with 1 for
    every two vertices joined by an edge (``beside``)."""

    faces: Faces
    pairs: Int[np.ndarray, "e 2"]
    beside: sparse.csr_array  # (v, v)


@dataclass(frozen=True, slots=True)
class MeshFaults:
    """Counts what is wrong with a mesh.

    Attributes:
        turned: triangles that face against the mean normal of their corners.
        folded: edges whose triangles' normals are more than ``MAX_FOLD_DEG`` apart.
        crossing: triangles that another one passes through, neighbours over an edge excepted.
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
    """Returns the topology of a model's full level."""
    return topology_of(model.levels["full"].faces, model.levels["full"].count)


def untangled_head(
    model: HeadModel, vertices: Vertices, deviation_mm: Float[np.ndarray, " v"]
) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """Returns the head without degenerate triangles, and the standard deviation of each vertex enlarged by the distance
    that it was moved.

    ``model``: the head model. ``vertices``: full level, mm. ``deviation_mm``: standard deviation of each vertex.
    """
    clean = untangled(vertices, head_topology(model), clean_mean_head(model))
    moved_mm = np.linalg.norm(clean - vertices, axis=1)
    return Mesh(clean, model.levels["full"].faces), np.hypot(deviation_mm, moved_mm)


@lru_cache(maxsize=2)
def clean_mean_head(model: HeadModel) -> Vertices:
    """Returns the full level of the model's mean head (head frame, mm) without degenerate triangles."""

    def make() -> dict[str, np.ndarray]:
        return {"vertices": untangled(model.vertices(np.zeros(0)), head_topology(model))}

    inputs = (model.mean, model.levels["full"].faces)
    return cached_arrays("clean-mean-head", inputs, make, made_by=(crossing_faces, component_of, HeadModel))["vertices"]


def untangled(vertices: Vertices, topology: Topology, rest: Vertices | None = None) -> Vertices:
    """Returns the vertices with every degenerate spot mended. The result is tested in single precision, as files
    store it.

    Args:
        vertices: mm.
        topology: of the mesh.
        rest: a shape of the same mesh without degenerate triangles, in any frame and scale; spots get its shape where
            that makes them clean. None makes membranes of all spots.
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
    """Returns the vertices (mm) of a fused surface without degenerate spots, tested in single precision. Small spots
    become membranes; where thin sheets would collapse so, vertices go to the places ``safe``, at which the whole mesh
    is clean."""
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
    """Gives spots the shape ``shape``, displaced as their surroundings are, each at most as often as ``rings`` has
    entries: how far it reaches at each time. Returns the vertices in single precision, the triangles that are still
    spoilt, and the vertices that were moved. ``enclosing`` adds the small pieces that spots cut off."""
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
    """Tells which triangles are turned over, folded onto a neighbour, or crossing another one. If ``within`` is not
    None, only triangles with a corner among those vertices, and those that they touch or cross, are tested."""
    active = None if within is None else any_corner(within, topology.faces)
    return turned_faces(vertices, topology, active) | crossing_faces(vertices, topology.faces, active)


def turned_faces(
    vertices: Vertices, topology: Topology, active: Bool[np.ndarray, " f"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Tells which triangles face against the mean normal of their corners, or are folded by more than ``MAX_FOLD_DEG``
    against a neighbour. If ``active`` is not None, only those triangles and their neighbours are tested."""
    faces, count = topology.faces, len(vertices)
    near = np.ones(len(faces), bool) if active is None else _around(_around(active, faces, count), faces, count)
    turned, folded = _turned_and_folded(vertices, topology, near)
    turned[folded] = True
    # At the border of what was looked at, means lack triangles.
    return turned if active is None else turned & _around(active, faces, count)


def mesh_faults(vertices: Vertices, topology: Topology, moved: Bool[np.ndarray, " v"] | None = None) -> MeshFaults:
    """Counts what is wrong with a mesh. Nothing that the model's own mean head has is excepted. If ``moved`` is not
    None, no triangles crossed before those vertices moved, and only theirs are tested for it."""
    active = None if moved is None else any_corner(moved, topology.faces)
    turned, folded = _turned_and_folded(vertices, topology, np.ones(len(topology.faces), bool))
    return MeshFaults(int(turned.sum()), len(folded), int(crossing_faces(vertices, topology.faces, active).sum()))


def _turned_and_folded(
    vertices: Vertices, topology: Topology, near: Bool[np.ndarray, " f"]
) -> tuple[Bool[np.ndarray, " f"], Int[np.ndarray, "e 2"]]:
    """Returns which triangles face against the mean normal of their corners, and the pairs of triangles that are folded
    at their common edge; of those in ``near`` alone."""
    args = vertices, topology.faces, topology.pairs, near, np.cos(np.radians(MAX_FOLD_DEG))
    turned, folded = turned_and_folded(*args)
    return turned, topology.pairs[folded]


def _around(chosen: Bool[np.ndarray, " f"], faces: Faces, count: int) -> Bool[np.ndarray, " f"]:
    """Returns the chosen triangles and those that share a corner with them."""
    corner = np.zeros(count, bool)
    corner[faces[chosen]] = True
    return any_corner(corner, faces)


def _with_rings(
    times: Int[np.ndarray, " v"], spoilt: Bool[np.ndarray, " f"], faces: Faces, rings: tuple[int, ...]
) -> Bool[np.ndarray, " v"]:
    """Returns the vertices of all spots: the corners of the spoilt triangles and the ``rings`` about them, whose number
    grows with how often a corner was spoilt."""
    spot, reach = np.unique(faces[spoilt]), np.zeros(len(times), int)
    reach[spot] = 1 + np.array(rings)[np.minimum(times[spot], len(rings)) - 1]
    for _ in range(int(reach.max()) - 1):
        part = faces[any_corner(reach > 1, faces)]
        np.maximum.at(reach, part.ravel(), np.repeat(reach[part].max(axis=1) - 1, 3))
    return reach > 0


def _with_enclosed(spot: Bool[np.ndarray, " v"], faces: Faces) -> Bool[np.ndarray, " v"]:
    """Returns the spot together with the small pieces of the mesh that it cuts off from the rest."""
    piece = component_of(faces[~any_corner(spot, faces)].astype(np.int32, copy=False), len(spot))
    size = np.bincount(piece[~spot], minlength=len(spot))
    return spot | (size[piece] < ENCLOSED_SHARE * len(spot))


def _membrane(vertices: Vertices, rows: Int[np.ndarray, " r"], topology: Topology) -> Float[np.ndarray, "r 3"]:
    """Returns the positions of the vertices ``rows`` at which each is the mean of its neighbours while all other
    vertices stay."""
    beside, free = topology.beside[rows], np.zeros(len(vertices), bool)
    free[rows] = True
    count = np.asarray(beside.sum(axis=1)).ravel()
    matrix = sparse.csc_array(sparse.diags_array(count) - beside[:, rows])
    return factorised(matrix).solve(beside @ np.where(free[:, None], 0.0, vertices))

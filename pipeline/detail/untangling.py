"""Repairs a head's mesh so that no triangle is turned over, folded onto its neighbour, or passes through another.

Expressions, kernel modes and displacements move vertices one by one, regardless of the surface: closed lips pass
through each other, lids that close fold behind the brow, an ear sinks into the head. Each such spot is replaced by the
membrane through its surroundings (every vertex the mean of its neighbours): loops shrink to nothing, and two sheets
that went through each other separate, as their borders are separate. If a spot is not clean then, it is enlarged by
rings of triangles. All other vertices stay where they are; most of these spots lie in slits that nobody sees.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int

from pipeline.detail.sparse_factor import factorised
from pipeline.fusion.crossings import crossing_faces
from pipeline.fusion.net_kernels import component_of
from pipeline.head_model.model import HeadModel
from rig.mesh import Mesh, face_normals

MAX_FOLD_DEG = 100.0  # between the normals of triangles that share an edge
RINGS = (1, 1, 2, 3, 4, 6, 8, 11, 15, 20, 26, 33, 41, 50)  # about a spot that was spoilt so many times; heads of random
# shapes and expressions need 5 to 8 of them
ENCLOSED_SHARE = 0.04  # of the vertices: a smaller piece that spoilt triangles cut off is a part of their loop or lens


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """Holds a mesh's triangles, the pairs of triangles that share an edge (``pairs``), and a sparse matrix with 1 for
    every two vertices joined by an edge (``beside``)."""

    faces: Int[np.ndarray, "f 3"]
    pairs: Int[np.ndarray, "e 2"]
    beside: sparse.csr_array  # (v, v)


def topology_of(faces: Int[np.ndarray, "f 3"], count: int) -> Topology:
    """Returns the topology of a mesh with ``count`` vertices."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    key, owner = ends[:, 0] * count + ends[:, 1], np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    low, high = np.divmod(np.unique(key), count)
    columns = (np.concatenate([low, high]), np.concatenate([high, low]))
    beside = sparse.csr_array((np.ones(2 * len(low)), columns), shape=(count, count))
    return Topology(faces, np.stack([owner[order][same], owner[order][same + 1]], axis=1), beside)


@lru_cache(maxsize=2)  # models are few, jobs are many
def head_topology(model: HeadModel) -> Topology:
    """Returns the topology of a model's full level."""
    return topology_of(model.levels["full"].faces, model.levels["full"].count)


def untangled_head(
    model: HeadModel, vertices: Float[np.ndarray, "v 3"], deviation_mm: Float[np.ndarray, " v"]
) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """Returns the head without degenerate triangles, and the standard deviation of each vertex enlarged by the distance
    that it was moved.

    Args:
        model: the head model.
        vertices: full level, mm.
        deviation_mm: standard deviation of each vertex.
    """
    clean = untangled(vertices, head_topology(model))
    moved_mm = np.linalg.norm(clean - vertices, axis=1)
    return Mesh(clean, model.levels["full"].faces), np.hypot(deviation_mm, moved_mm)


def untangled(vertices: Float[np.ndarray, "v 3"], topology: Topology) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices with every degenerate spot smoothed. The result is tested in single precision, as files
    store it."""
    out, faces = vertices.astype(np.float32, order="C").astype(float), topology.faces
    times, touched = np.zeros(len(out), int), np.zeros(len(out), bool)
    spoilt = spoilt_faces(out, topology)
    while spoilt.any() and times.max() < len(RINGS):
        times[np.unique(faces[spoilt])] += 1
        spot = _with_enclosed(_with_rings(times, spoilt, faces), faces)
        if spot.all():
            break
        rows = np.flatnonzero(spot)
        out[rows] = _membrane(out, rows, topology).astype(np.float32)
        touched |= spot
        spoilt = spoilt_faces(out, topology, spot)
    return np.where(touched[:, None], out, vertices)


def spoilt_faces(
    vertices: Float[np.ndarray, "v 3"], topology: Topology, within: Bool[np.ndarray, " v"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Tells which triangles are turned over, folded onto a neighbour, or crossing another one. If ``within`` is not
    None, only triangles with a corner among those vertices, and those that they touch or cross, are tested."""
    active = None if within is None else _any_corner(within, topology.faces)
    return turned_faces(vertices, topology, active) | crossing_faces(vertices, topology.faces, active)


def turned_faces(
    vertices: Float[np.ndarray, "v 3"], topology: Topology, active: Bool[np.ndarray, " f"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Tells which triangles face against the mean normal of their corners, or are folded by more than ``MAX_FOLD_DEG``
    against a neighbour. If ``active`` is not None, only those triangles and their neighbours are tested."""
    faces, count = topology.faces, len(vertices)
    near = np.ones(len(faces), bool) if active is None else _around(_around(active, faces, count), faces, count)
    rows, pairs = np.flatnonzero(near), topology.pairs
    triangle_normals = face_normals(vertices, faces[rows])
    corners = faces[rows].ravel()
    mean = np.stack([np.bincount(corners, np.repeat(triangle_normals[:, k], 3), count) for k in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    turned, unit = np.zeros(len(faces), bool), np.zeros((len(faces), 3))
    a, b, c = faces[rows].T
    turned[rows] = np.einsum("fk,fk->f", triangle_normals, mean[a] + mean[b] + mean[c]) <= 0.0
    unit[rows] = (
        triangle_normals
        / np.maximum(np.sqrt(np.einsum("fk,fk->f", triangle_normals, triangle_normals)), 1e-12)[:, None]
    )
    pairs = pairs if active is None else pairs[near[pairs[:, 0]] & near[pairs[:, 1]]]
    cosine = np.einsum("ek,ek->e", unit[pairs[:, 0]], unit[pairs[:, 1]])
    turned[pairs[cosine < np.cos(np.radians(MAX_FOLD_DEG))]] = True
    # At the border of what was looked at, means lack triangles.
    return turned if active is None else turned & _around(active, faces, count)


def _around(chosen: Bool[np.ndarray, " f"], faces: Int[np.ndarray, "f 3"], count: int) -> Bool[np.ndarray, " f"]:
    """Returns the chosen triangles and those that share a corner with them."""
    corner = np.zeros(count, bool)
    corner[faces[chosen]] = True
    return _any_corner(corner, faces)


def _any_corner(vertex: Bool[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    return vertex[faces[:, 0]] | vertex[faces[:, 1]] | vertex[faces[:, 2]]  # a tenth of the time of ``any(axis=1)``


def _with_rings(
    times: Int[np.ndarray, " v"], spoilt: Bool[np.ndarray, " f"], faces: Int[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " v"]:
    """Returns the vertices of all spots: the corners of the spoilt triangles and the rings about them. The number of
    rings (``RINGS``) grows with how often a corner was spoilt."""
    spot, reach = np.unique(faces[spoilt]), np.zeros(len(times), int)
    reach[spot] = 1 + np.array(RINGS)[np.minimum(times[spot], len(RINGS)) - 1]
    for _ in range(int(reach.max()) - 1):
        part = faces[_any_corner(reach > 1, faces)]
        np.maximum.at(reach, part.ravel(), np.repeat(reach[part].max(axis=1) - 1, 3))
    return reach > 0


def _with_enclosed(spot: Bool[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " v"]:
    """Returns the spot together with the small pieces of the mesh that it cuts off from the rest."""
    piece = component_of(faces[~_any_corner(spot, faces)].astype(np.int32, copy=False), len(spot))
    size = np.bincount(piece[~spot], minlength=len(spot))
    return spot | (size[piece] < ENCLOSED_SHARE * len(spot))


def _membrane(
    vertices: Float[np.ndarray, "v 3"], rows: Int[np.ndarray, " r"], topology: Topology
) -> Float[np.ndarray, "r 3"]:
    """Returns the positions of the vertices ``rows`` at which each is the mean of its neighbours while all other
    vertices stay."""
    beside, free = topology.beside[rows], np.zeros(len(vertices), bool)
    free[rows] = True
    count = np.asarray(beside.sum(axis=1)).ravel()
    matrix = sparse.csc_array(sparse.diags_array(count) - beside[:, rows])
    return factorised(matrix).solve(beside @ np.where(free[:, None], 0.0, vertices))

"""Compiled loops that make the surface net of a sparse grid a two-manifold, and find its connected pieces.

A net (``pipeline.geometry.surface_nets``) is a manifold exactly if the set of inside nodes is well composed (Latecki,
*3D well-composed pictures*, 1997): no square of four nodes has inside nodes on one diagonal and outside nodes on the
other, and no cell has two opposite corners that differ from its six others. The signs of single nodes are changed until
that holds.
"""

import numpy as np

from pipeline.geometry.surface_nets_kernels import corners_of
from rig.jit import njit

SQUARES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]], np.int64
)  # around each face of a cell
ROUNDS = 12  # in which the node nearest to the surface is turned over; later ones only fill, which comes to an end


@njit(cache=True, nogil=True)
def compose_well(field: np.ndarray, neighbours: np.ndarray, outer: np.ndarray, least: float) -> int:
    """Changes the signs of nodes of ``field`` (n; mm, negative inside), in place, until its inside is well composed.
    Such a node gets the value ``least`` or -``least``. Returns how often a sign was changed.

    ``neighbours`` (n, 6) has the rows of adjacent nodes, -1 for none. ``outer`` nodes (n) are never changed, since the
    surface would then lie in cells that the grid does not have.
    """
    corners, stale = np.empty(8, np.int64), np.ones(len(field), np.bool_)  # cells that have changed since their turn
    turned, changes, rounds = 0, 1, 0
    while changes:
        changes = 0
        for n in range(len(field)):
            if not stale[n]:
                continue
            stale[n] = False
            if not corners_of(n, neighbours, corners):
                continue
            inside = 0
            for c in range(8):
                inside += field[corners[c]] < 0
            if inside < 2 or inside > 6:
                continue
            node = _culprit(field, outer, corners, inside, rounds >= ROUNDS)
            if node >= 0:
                field[node] = least if field[node] < 0 else -least
                changes += 1
                _mark_cells_about(node, neighbours, stale)
        turned += changes
        rounds += 1
    return turned


@njit(cache=True, nogil=True, inline="always")
def _mark_cells_about(node, neighbours, marked):
    for c in range(8):
        at = node
        if c & 1:
            at = neighbours[at, 4]
        if at >= 0 and c & 2:
            at = neighbours[at, 2]
        if at >= 0 and c & 4:
            at = neighbours[at, 0]
        if at >= 0:
            marked[at] = True


@njit(cache=True, nogil=True, inline="always")
def _culprit(field, outer, corners, inside, fill):
    """The node to turn over in a cell that is not well composed, or -1: the one nearest to the surface."""
    worst, least = -1, np.inf
    for s in range(6):
        a, b = field[corners[SQUARES[s, 0]]] < 0, field[corners[SQUARES[s, 1]]] < 0
        c, d = field[corners[SQUARES[s, 2]]] < 0, field[corners[SQUARES[s, 3]]] < 0
        if a == c and b == d and a != b:
            for k in range(4):
                node = corners[SQUARES[s, k]]
                if abs(field[node]) < least and not outer[node] and not (fill and field[node] < 0):
                    worst, least = node, abs(field[node])
    if worst >= 0 or (inside != 2 and inside != 6):
        return worst
    for c in range(4):
        alone = field[corners[c]] < 0
        if (field[corners[7 - c]] < 0) == alone and alone == (inside == 2):
            for k in range(8):
                node = corners[k]
                if abs(field[node]) < least and not outer[node] and not (fill and field[node] < 0):
                    worst, least = node, abs(field[node])
    return worst


@njit(cache=True, nogil=True)
def component_of(faces: np.ndarray, count: int) -> np.ndarray:
    """Returns, for each of ``count`` vertices, the lowest vertex of its connected piece of the mesh, int32."""
    root = np.arange(count).astype(np.int32)
    for f in range(len(faces)):
        for k in range(2):
            a, b = faces[f, k], faces[f, k + 1]
            while root[a] != a:
                root[a] = root[root[a]]
                a = root[a]
            while root[b] != b:
                root[b] = root[root[b]]
                b = root[b]
            if a < b:
                root[b] = a
            else:
                root[a] = b
    for v in range(count):
        while root[v] != root[root[v]]:
            root[v] = root[root[v]]
    return root

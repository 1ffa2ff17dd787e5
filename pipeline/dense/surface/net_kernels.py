"""A closed two-manifold between the nodes of a sparse grid that lie inside and outside (compiled).

Naive surface nets (Gibson, *Constrained elastic surface nets*, 1998): a vertex in every cell with both signs, a
quadrilateral over every edge with both. The mesh is a manifold exactly if the set of inside nodes is well composed
(Latecki, *3D well-composed pictures*, 1997): no square of four nodes has its diagonals of opposite kind, and no cell
has two opposite corners alone of one kind. Nodes are turned over until that holds.
"""

import numpy as np

from pipeline.compiled import njit
from pipeline.dense.surface.grid_kernels import corners_of

SQUARES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]], np.int64
)  # around each face of a cell
EDGES = np.array(
    [[0, 4], [1, 5], [2, 6], [3, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 1], [2, 3], [4, 5], [6, 7]], np.int64
)
ROUNDS = 12  # in which the node nearest to the surface is turned over; later ones only fill, which comes to an end


@njit(cache=True, nogil=True)
def compose_well(field: np.ndarray, neighbours: np.ndarray, outer: np.ndarray, least: float) -> int:
    """Turns nodes of ``field`` over (to +-``least``) until the inside is well composed; returns how many. ``outer``
    nodes stay: the surface would lie in cells that the grid does not have."""
    corners = np.empty(8, np.int64)
    turned, changes, rounds = 0, 1, 0
    while changes:
        changes = 0
        for n in range(len(field)):
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
        turned += changes
        rounds += 1
    return turned


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
def net_vertices(field: np.ndarray, index: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (float64, in steps), the mean of the places where their cells' edges cross the surface; and the vertex
    (int32) of each node's cell, -1 where there is none."""
    corners = np.empty(8, np.int64)
    of_cell = np.full(len(field), -1, np.int32)
    vertices = np.empty((len(field), 3))
    count = 0
    for n in range(len(field)):
        if not corners_of(n, neighbours, corners):
            continue
        total, x, y, z = 0, 0.0, 0.0, 0.0
        for e in range(12):
            a, b = EDGES[e, 0], EDGES[e, 1]
            low, high = field[corners[a]], field[corners[b]]
            if (low < 0) != (high < 0):
                t = low / (low - high)
                x += (a >> 2) + t * ((b >> 2) - (a >> 2))
                y += ((a >> 1) & 1) + t * (((b >> 1) & 1) - ((a >> 1) & 1))
                z += (a & 1) + t * ((b & 1) - (a & 1))
                total += 1
        if total:
            vertices[count, 0] = index[n, 0] + x / total
            vertices[count, 1] = index[n, 1] + y / total
            vertices[count, 2] = index[n, 2] + z / total
            of_cell[n] = count
            count += 1
    return vertices[:count].copy(), of_cell


@njit(cache=True, nogil=True)
def net_faces(field: np.ndarray, neighbours: np.ndarray, vertices: np.ndarray, of_cell: np.ndarray) -> np.ndarray:
    """Triangles (int32), wound outwards: two for every edge with both signs, split along the shorter diagonal."""
    faces = np.empty((6 * len(vertices) + 16, 3), np.int32)
    made = 0
    for n in range(len(field)):
        for axis in range(3):
            other = neighbours[n, 2 * axis + 1]
            if other < 0 or (field[other] < 0) == (field[n] < 0):
                continue
            first, second = 2 * ((axis + 1) % 3), 2 * ((axis + 2) % 3)  # towards the low side of the other two axes
            along = neighbours[n, first]
            a, b, c, d = of_cell[neighbours[along, second]], of_cell[neighbours[n, second]], of_cell[n], of_cell[along]
            if field[n] >= 0:  # the outside lies towards the low end of the edge
                b, d = d, b
            if _distance2(vertices, a, c) > _distance2(vertices, b, d):
                a, b, c, d = b, c, d, a
            faces[made, 0], faces[made, 1], faces[made, 2] = a, b, c
            faces[made + 1, 0], faces[made + 1, 1], faces[made + 1, 2] = a, c, d
            made += 2
    return faces[:made].copy()


@njit(cache=True, nogil=True, inline="always")
def _distance2(vertices, a, b):
    total = 0.0
    for k in range(3):
        total += (vertices[a, k] - vertices[b, k]) ** 2
    return total


@njit(cache=True, nogil=True)
def component_of(faces: np.ndarray, count: int) -> np.ndarray:
    """The lowest vertex of the connected piece that each vertex belongs to."""
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

"""Holds the compiled loops of ``pipeline.geometry.surface_nets``. The nodes of a sparse grid are sorted by their number
in the full grid."""

import numpy as np

from rig.jit import njit

EDGES = np.array(
    [[0, 4], [1, 5], [2, 6], [3, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 1], [2, 3], [4, 5], [6, 7]], np.int64
)


@njit(cache=True, nogil=True, inline="always")
def corners_of(n: int, neighbours: np.ndarray, corners: np.ndarray) -> bool:
    """Fills ``corners`` (8) with the node indices of the cell whose lowest node is ``n``; returns False if the grid
    lacks a corner. Corner c has the offset (c >> 2, (c >> 1) & 1, c & 1). ``neighbours`` is the result of ``linked``.
    """
    for c in range(8):
        at = n
        if c & 4:
            at = neighbours[at, 1]
        if at >= 0 and c & 2:
            at = neighbours[at, 3]
        if at >= 0 and c & 1:
            at = neighbours[at, 5]
        if at < 0:
            return False
        corners[c] = at
    return True


@njit(cache=True, nogil=True)
def linked(index: np.ndarray, keys: np.ndarray, ny: int, nz: int) -> np.ndarray:
    """Returns the indices (n, 6) of every node's neighbours: below and above along x, then y, then z; -1 if there is no
    neighbour.

    ``index`` (n, 3) are the nodes' positions, ``keys`` (n, ascending) their ranks in a full grid of ``ny`` by ``nz``
    nodes for each x.
    """
    count = len(keys)
    out = np.full((count, 6), -1, np.int32)
    steps = (np.int64(ny) * nz, np.int64(nz), np.int64(1))
    for axis in range(3):
        step, other = steps[axis], 0
        for n in range(count):
            while other < count and keys[other] < keys[n] + step:
                other += 1
            if other == count:
                break
            # A key further may also be the beginning of the next row.
            if keys[other] == keys[n] + step and index[other, axis] == index[n, axis] + 1:
                out[n, 2 * axis + 1] = other
                out[other, 2 * axis] = n
    return out


@njit(cache=True, nogil=True)
def net_vertices(field: np.ndarray, index: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (float64, in grid steps) of the surface net: in each cell that the surface crosses, the mean
    of its crossings with the cell's edges. The function also returns the vertex index (int32) of each node's cell, -1
    for a cell without a vertex."""
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
    """Returns the triangles (int32, facing outwards) of the surface net: two for every grid edge whose ends differ in
    sign, between the vertices of the four cells around the edge. Each quadrilateral is split along its shorter
    diagonal."""
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

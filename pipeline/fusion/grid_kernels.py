"""Contains the compiled loops that refine a sparse grid, interpolate a smooth field (membrane) on it, and make its
surface net a manifold.

The membrane is solved by successive over-relaxation in a chequerboard order. Nodes of one colour are not neighbours, so
the result does not depend on the order of threads.

A surface net (``pipeline.geometry.surface_nets``) is a manifold exactly if the set of inside nodes is well composed
(Latecki, *3D well-composed pictures*, 1997). In a well-composed set no square of four nodes has inside nodes on one
diagonal and outside nodes on the other, and no cell has two opposite corners that differ from its six others. The signs
of single nodes are changed until the set of inside nodes is well composed.
"""

from typing import NamedTuple

import numpy as np

from pipeline.geometry.surface_nets_kernels import corners_of
from rig.jit import njit

SQUARES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]], np.int64
)  # around each face of a cell
ROUNDS = 12  # in which the node nearest to the surface is turned over; later ones only fill, which comes to an end


@njit(cache=True, nogil=True)
def halved(wanted: np.ndarray) -> np.ndarray:
    """Returns the nodes of a grid with half the step, as grid indices (n, 3) int32 sorted by their keys. Each
    ``wanted`` node (i, j, k) becomes up to eight nodes: (2 i, 2 j, 2 k) and its successors along x, y and z inside the
    grid."""
    nx, ny, nz = wanted.shape
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if wanted[i, j, k]:
                    count += (2 if i < nx - 1 else 1) * (2 if j < ny - 1 else 1) * (2 if k < nz - 1 else 1)
    index = np.empty((count, 3), np.int32)
    made = 0
    for i in range(2 * nx - 1):
        for j in range(2 * ny - 1):
            for k in range(nz):
                if not wanted[i // 2, j // 2, k]:
                    continue
                for half in range(2 if k < nz - 1 else 1):
                    index[made, 0], index[made, 1], index[made, 2] = i, j, 2 * k + half
                    made += 1
    return index


@njit(cache=True, nogil=True)
def outermost(neighbours: np.ndarray) -> np.ndarray:
    """Returns a mask (n) of the nodes of a sparse grid that lack one of their 26 neighbours. ``neighbours`` (n, 6) has
    the indices of the six nearest neighbours, -1 for none."""
    count = len(neighbours)
    full = np.ones(count, np.bool_)
    for axis in range(3):  # a node has all 3^d neighbours of d axes if it and both next to it have those of d - 1
        before = full.copy()
        for n in range(count):
            low, high = neighbours[n, 2 * axis], neighbours[n, 2 * axis + 1]
            full[n] = before[n] and low >= 0 and high >= 0 and before[low] and before[high]
    return ~full


@njit(cache=True, nogil=True)
def interpolated(box: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Interpolates a coarse volume linearly at nodes (n, 3) of a grid with half its step."""
    out = np.empty(len(index), np.float32)
    for n in range(len(index)):
        i, j, k = index[n, 0], index[n, 1], index[n, 2]
        total = 0.0
        for a in (i // 2, (i + 1) // 2):
            for b in (j // 2, (j + 1) // 2):
                for c in (k // 2, (k + 1) // 2):
                    total += box[a, b, c]
        out[n] = total / 8
    return out


@njit(cache=True, nogil=True)
def doubled(box: np.ndarray) -> np.ndarray:
    """Returns a volume interpolated linearly to half its step: (2 nx - 1, 2 ny - 1, 2 nz - 1)."""
    nx, ny, nz = box.shape
    out = np.empty((2 * nx - 1, 2 * ny - 1, 2 * nz - 1), np.float32)
    for i in range(2 * nx - 1):
        a, b = i // 2, (i + 1) // 2
        for j in range(2 * ny - 1):
            c, d = j // 2, (j + 1) // 2
            for k in range(nz):
                here = 0.25 * (box[a, c, k] + box[a, d, k] + box[b, c, k] + box[b, d, k])
                out[i, j, 2 * k] = here
                if k > 0:
                    out[i, j, 2 * k - 1] = 0.5 * (out[i, j, 2 * k - 2] + here)
    return out


@njit(cache=True, nogil=True)
def grown(marked: np.ndarray) -> np.ndarray:
    """Returns the marked nodes of a volume together with their 26 neighbours."""
    nx, ny, nz = marked.shape
    out = marked.copy()
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if marked[i, j, k]:
                    out[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2, max(0, k - 1) : k + 2] = True
    return out


@njit(cache=True, nogil=True)
def crossed(values: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Returns a mask (n) of the nodes that are the lowest corner of a cell with values of both signs, which the surface
    crosses."""
    out = np.zeros(len(values), np.bool_)
    corners = np.empty(8, np.int64)
    for n in range(len(values)):
        if corners_of(n, neighbours, corners):
            inside = 0
            for c in range(8):
                inside += values[corners[c]] < 0
            out[n] = 0 < inside < 8
    return out


@njit(cache=True, nogil=True)
def crossed_at_rim(values: np.ndarray, neighbours: np.ndarray, outer: np.ndarray) -> bool:
    """Returns True if the sign of ``values`` changes between two neighbouring ``outer`` nodes, so that the surface
    leaves the grid."""
    for n in range(len(values)):
        for axis in range(3):
            other = neighbours[n, 2 * axis + 1]
            if other >= 0 and outer[n] and outer[other] and (values[n] < 0) != (values[other] < 0):
                return True
    return False


class Membrane(NamedTuple):
    """Holds the target value, its weight and the lower bound of a smooth field at each of n nodes."""

    target: np.ndarray
    weight: np.ndarray
    bound: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def relax(
    field: np.ndarray,
    membrane: Membrane,
    free: np.ndarray,
    neighbours: np.ndarray,
    factor: float,
    first: int,
    last: int,
) -> None:
    """Updates ``field`` (n), in place, at the nodes ``free[first:last]`` of one colour. The step reduces ``sum w (u -
    target)^2 + sum over edges (u - u')^2`` subject to ``u >= bound``.

    ``neighbours`` (n, 6) are the indices of adjacent nodes, -1 for none. ``factor`` is the over-relaxation (1 to 2).
    """
    target, weight, bound = membrane
    for at in range(first, last):
        n = free[at]
        total, count = 0.0, 0
        for side in range(6):
            other = neighbours[n, side]
            if other >= 0:
                total += field[other]
                count += 1
        best = (total + weight[n] * target[n]) / (count + weight[n])
        field[n] = max(bound[n], field[n] + factor * (best - field[n]))


@njit(cache=True, nogil=True)
def compose_well(field: np.ndarray, neighbours: np.ndarray, outer: np.ndarray, least: float) -> int:
    """Changes signs in ``field`` (n; mm, negative inside), in place, until the set of inside nodes is well composed. A
    changed node of the grid gets the value ``least`` or -``least``. Returns the number of changed nodes.

    ``neighbours`` (n, 6) has the indices of adjacent nodes, -1 for none. ``outer`` nodes (n) are never changed, since
    the surface would then leave the grid.
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
    """Returns the node nearest to the surface if a cell is not well composed, since its sign must change; else -1."""
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
    """Returns, for each of ``count`` vertices, the lowest vertex index in its connected component, int32."""
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

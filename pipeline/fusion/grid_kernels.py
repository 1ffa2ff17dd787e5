"""Compiled loops of ``pipeline.fusion.grid`` with a membrane through known values, and those that make its net a
manifold.

The membrane is over-relaxed Gauss-Seidel on nodes that are coloured like a chequerboard: nodes of one colour are not
neighbours, so that threads do not disturb each other and the result does not depend on their order.

A net (``pipeline.geometry.surface_nets``) is a manifold exactly if the set of inside nodes is well composed (Latecki,
*3D well-composed pictures*, 1997): no square of four nodes has inside nodes on one diagonal and outside nodes on the
other, and no cell has two opposite corners that differ from its six others. The signs of single nodes are changed until
that holds.
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
    """Returns the nodes of a grid with half the step, as positions (n, 3) int32 in the order of their keys. Each
    ``wanted`` node (i, j, k) becomes up to eight nodes: (2 i, 2 j, 2 k), and those one further along x, y and z that
    are inside the grid."""
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
    """Tells which nodes (n) of a sparse grid lack one of their 26 neighbours. ``neighbours`` (n, 6) has the rows of the
    six nearest ones, -1 for none."""
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
    """Interpolates a coarse volume to nodes (n, 3) of half its step: the mean of the two, four or eight nodes around,
    or the value of the same node."""
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
    """Tells which nodes (n) are the lowest corner of a cell that has corners of both signs, so that the surface crosses
    it."""
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
    """Tells whether the sign of ``values`` changes between two neighbouring ``outer`` nodes: the surface leaves the
    grid there."""
    for n in range(len(values)):
        for axis in range(3):
            other = neighbours[n, 2 * axis + 1]
            if other >= 0 and outer[n] and outer[other] and (values[n] < 0) != (values[other] < 0):
                return True
    return False


class Membrane(NamedTuple):
    """Holds what determines the field at each of n nodes: the value that it is drawn to and with which weight, and a
    lower bound."""

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
    """Updates ``field`` (n), in place, at the rows ``free[first:last]``, nodes of one colour: one step towards
    the minimum of ``sum w (u - target)^2 + sum over edges (u - u')^2`` subject to ``u >= bound``.

    ``neighbours`` (n, 6) are the rows of adjacent nodes, -1 for none, and ``factor`` the over-relaxation (1: none,
    below 2).
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

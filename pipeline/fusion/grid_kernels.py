"""Compiled loops of ``pipeline.fusion.grid``, and one that continues a field smoothly where it is unknown: a membrane
through the known values.

That is over-relaxed Gauss-Seidel on nodes that are coloured like a chequerboard: nodes of one colour are not
neighbours, so that threads do not disturb each other and the result does not depend on their order.
"""

from typing import NamedTuple

import numpy as np

from pipeline.geometry.surface_nets_kernels import corners_of
from rig.jit import njit


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

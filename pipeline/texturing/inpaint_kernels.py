"""Compiled loops of ``pipeline.texturing.neighbourhood``."""

import numpy as np

from rig.jit import njit

LANES = 4  # channels side by side, so that a vertex is one vector register: 16 bytes


@njit(cache=True)
def by_rings(starts: np.ndarray, indices: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Returns the unknown vertices in the order in which a flood from the known ones reaches them. Vertices that it
    does not reach are left out."""
    met = known.copy()
    queue = np.empty(len(known), np.int32)
    tail = 0
    for v in range(len(known)):
        if known[v]:
            for k in range(starts[v], starts[v + 1]):
                if not met[indices[k]]:
                    met[indices[k]] = True
                    queue[tail] = indices[k]
                    tail += 1
    head = 0
    while head < tail:
        v = queue[head]
        head += 1
        for k in range(starts[v], starts[v + 1]):
            if not met[indices[k]]:
                met[indices[k]] = True
                queue[tail] = indices[k]
                tail += 1
    return queue[:tail].copy()


@njit(cache=True)
def first_guess(
    values: np.ndarray, starts: np.ndarray, indices: np.ndarray, order: np.ndarray, known: np.ndarray
) -> None:
    """Gives every vertex of ``order`` in turn the mean of its neighbours that are ``known`` by then. Changes ``values``
    (v, LANES) and ``known`` (v) in place."""
    for v in order:
        total, count = np.zeros(LANES, np.float32), 0
        for k in range(starts[v], starts[v + 1]):
            if known[indices[k]]:
                total += values[indices[k]]
                count += 1
        values[v] = total / np.float32(max(count, 1))
        known[v] = True


@njit(cache=True, error_model="numpy")
def relax(
    values: np.ndarray, starts: np.ndarray, indices: np.ndarray, order: np.ndarray, sweeps: int, factor: float
) -> None:
    """Relaxes the vertices of ``order`` towards the mean of their neighbours, by over-relaxed (``factor``) Gauss-Seidel
    sweeps forth and back. Changes ``values`` (v, LANES) in place, four numbers at once."""
    for sweep in range(sweeps):
        for step in range(len(order)):
            v = order[step] if sweep % 2 == 0 else order[len(order) - 1 - step]
            a, b, c, d = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(starts[v], starts[v + 1]):
                at = indices[k]
                a += values[at, 0]
                b += values[at, 1]
                c += values[at, 2]
                d += values[at, 3]
            share, kept = np.float32(factor / (starts[v + 1] - starts[v])), np.float32(1.0 - factor)
            values[v, 0] = kept * values[v, 0] + share * a
            values[v, 1] = kept * values[v, 1] + share * b
            values[v, 2] = kept * values[v, 2] + share * c
            values[v, 3] = kept * values[v, 3] + share * d

"""Values for the vertices that have none, smooth over the mesh: each ring takes the mean of the ring before, and the
filled part is then relaxed towards its neighbours' mean (the harmonic fill), the known vertices staying as they are."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

RELAXATIONS = ((60, 1.7), (10, 1.0))  # sweeps and factor: over-relaxed, then plain, which calms what overshot


def neighbours(faces: Int[np.ndarray, "f 3"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Adjacency of the vertices in compressed rows: starts (count + 1,) and indices. A pair may occur twice."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    order = np.argsort(ends[:, 0], kind="stable")
    starts = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(ends[:, 0], minlength=count), out=starts[1:])
    return starts, ends[order, 1].astype(np.int32)


def fill_unknown(
    values: Float[np.ndarray, "v c"], known: Bool[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v c"]:
    """``values`` with the unknown ones filled; parts of the mesh that know nothing take the mean of the rest."""
    out = values.astype(float)
    if known.all() or not known.any():
        return out
    out[~known] = out[known].mean(axis=0)
    starts, indices = neighbours(faces, len(values))
    order = _by_rings(starts, indices, known)
    _first_guess(out, starts, indices, order, known.copy())
    for sweeps, factor in RELAXATIONS:
        _relax(out, starts, indices, order, sweeps, factor)
    return out


@njit(cache=True)
def _by_rings(starts: np.ndarray, indices: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Unknown vertices in the order in which a flood from the known ones meets them."""
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
def _first_guess(
    values: np.ndarray, starts: np.ndarray, indices: np.ndarray, order: np.ndarray, known: np.ndarray
) -> None:
    for step in range(len(order)):
        v = order[step]
        count = 0
        total = np.zeros(values.shape[1])
        for k in range(starts[v], starts[v + 1]):
            if known[indices[k]]:
                total += values[indices[k]]
                count += 1
        values[v] = total / max(count, 1)
        known[v] = True


@njit(cache=True)
def _relax(
    values: np.ndarray, starts: np.ndarray, indices: np.ndarray, order: np.ndarray, sweeps: int, factor: float
) -> None:
    channels = values.shape[1]
    for sweep in range(sweeps):
        for step in range(len(order)):
            v = order[step] if sweep % 2 == 0 else order[len(order) - 1 - step]
            first, last = starts[v], starts[v + 1]
            for c in range(channels):
                total = 0.0
                for k in range(first, last):
                    total += values[indices[k], c]
                values[v, c] += factor * (total / (last - first) - values[v, c])

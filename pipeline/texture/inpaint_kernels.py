"""Compiled loops of ``pipeline.texture.inpaint``."""

import numpy as np

from pipeline.compiled import njit


@njit(cache=True)
def by_rings(starts: np.ndarray, indices: np.ndarray, known: np.ndarray) -> np.ndarray:
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
def first_guess(
    values: np.ndarray, starts: np.ndarray, indices: np.ndarray, order: np.ndarray, known: np.ndarray
) -> None:
    for step in range(len(order)):
        v = order[step]
        count = 0
        for k in range(starts[v], starts[v + 1]):
            count += known[indices[k]]
        for c in range(values.shape[1]):
            total = 0.0
            for k in range(starts[v], starts[v + 1]):
                if known[indices[k]]:
                    total += values[indices[k], c]
            values[v, c] = total / max(count, 1)
        known[v] = True


@njit(cache=True)
def relax(
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

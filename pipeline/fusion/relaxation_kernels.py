"""The membrane through what is known of a field: over-relaxed Gauss-Seidel on a sparse grid, one colour at a time, so
that threads never meet and the order of work does not show (compiled)."""

from typing import NamedTuple

import numpy as np

from pipeline.compute.jit import njit


class Membrane(NamedTuple):
    """What holds the field: where it is drawn to and how much, what it may not go below, and where it stays."""

    target: np.ndarray
    weight: np.ndarray
    bound: np.ndarray
    fixed: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def relax(
    field: np.ndarray,
    membrane: Membrane,
    index: np.ndarray,
    neighbours: np.ndarray,
    colour: int,
    factor: float,
    first: int,
    last: int,
) -> None:
    """One half sweep towards the least of ``sum w (u - target)^2 + sum over edges (u - u')^2`` with ``u >= bound``."""
    target, weight, bound, fixed = membrane
    for n in range(first, last):
        if fixed[n] or (index[n, 0] + index[n, 1] + index[n, 2]) & 1 != colour:
            continue
        total, count = 0.0, 0
        for side in range(6):
            other = neighbours[n, side]
            if other >= 0:
                total += field[other]
                count += 1
        best = (total + weight[n] * target[n]) / (count + weight[n])
        field[n] = max(bound[n], field[n] + factor * (best - field[n]))

"""Compiled loop that continues a field smoothly where it is unknown: a membrane through the known values.

It is over-relaxed Gauss-Seidel on a sparse grid whose nodes are coloured like a chequerboard. Nodes of one colour are
not neighbours, so that threads do not disturb each other and the result does not depend on their order.
"""

from typing import NamedTuple

import numpy as np

from rig.jit import njit


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

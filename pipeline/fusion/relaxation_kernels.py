"""Compiled loop that continues a field smoothly where it is unknown: a membrane through the known values.

It is over-relaxed Gauss-Seidel on a sparse grid whose nodes are coloured like a chequerboard. Nodes of one colour are
not neighbours, so that threads do not disturb each other and the result does not depend on their order.
"""

from typing import NamedTuple

import numpy as np

from pipeline.compute.jit import njit


class Membrane(NamedTuple):
    """Holds what determines the field at each of n nodes: the value that it is drawn to and with which weight, a lower
    bound, and whether it is fixed."""

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
    """Updates ``field`` (n) at the nodes ``first`` to ``last`` of one ``colour`` (0 or 1), in place: one step towards
    the minimum of ``sum w (u - target)^2 + sum over edges (u - u')^2`` subject to ``u >= bound``.

    ``index`` (n, 3) is the grid position of each node, ``neighbours`` (n, 6) the rows of adjacent nodes, -1 for none,
    and ``factor`` the over-relaxation (1: none, below 2).
    """
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

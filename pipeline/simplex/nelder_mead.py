"""Minimises a function without derivatives by the downhill simplex of the paper's section 4.4: Nelder and Mead 1965, as
described by Press et al., Numerical Recipes, section 10.4. This module contains nothing about heads.

The factors are those of Numerical Recipes: reflection 1, expansion 2, contraction 1/2, shrinking 1/2 towards the best
point. The search ends at a small relative spread ``2 |f_high - f_low| / (|f_high| + |f_low|)`` of the function's
values."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Function = Callable[[Float[np.ndarray, " n"]], float]
Watcher = Callable[[int, float], None]

SPREAD_TINY = 1e-30  # keeps the relative spread defined at a minimum of exactly zero


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Holds the best point (``value``), the function's value there (``cost``), why the search ended (``result``), and
    the number of function calls (``evaluations``)."""

    value: Float[np.ndarray, " n"]
    result: Literal["converged", "evaluation limit"]
    evaluations: int
    cost: float


def minimise(
    function: Function,
    start: Float[np.ndarray, " n"],
    steps: Float[np.ndarray, " n"],
    *,
    tolerance: float = 1e-4,
    limit: int = 3500,
    watch: Watcher = lambda evaluations, cost: None,
) -> Solution:
    """Searches for a local minimum of ``function`` by the downhill simplex.

    The initial simplex is ``p_0 = start`` and ``p_i = p_0 + steps[i] e_i`` (the paper's section 4.4). The search ends
    when the relative spread falls below ``tolerance``, or after the first move that reaches ``limit`` evaluations (a
    shrink may exceed it by n + 1). ``watch(evaluations, least value)`` is called after every move and may raise an
    exception to stop the search."""
    points = np.vstack([start, start + np.diag(steps)])
    values = np.array([function(point) for point in points])
    evaluations = len(values)
    while True:
        order = np.argsort(values, kind="stable")
        points, values = points[order], values[order]
        spread = 2.0 * (values[-1] - values[0]) / (abs(values[-1]) + abs(values[0]) + SPREAD_TINY)
        cost = float(values[0])
        watch(evaluations, cost)
        if spread < tolerance:
            return Solution(points[0], "converged", evaluations, cost)
        if evaluations >= limit:
            return Solution(points[0], "evaluation limit", evaluations, cost)
        evaluations += _move(function, points, values)


def _move(function: Function, points: Float[np.ndarray, "n1 n"], values: Float[np.ndarray, " n1"]) -> int:
    """Replaces the worst point of the sorted simplex, or shrinks the simplex, in place. Returns the number of function
    evaluations."""
    centre = points[:-1].mean(axis=0)

    def try_at(factor: float) -> tuple[Float[np.ndarray, " n"], float]:
        """Returns the point at ``factor`` times the worst point's offset from the others' centroid, and its value."""
        point = centre + factor * (points[-1] - centre)
        return point, function(point)

    reflected, cost = try_at(-1.0)
    if cost < values[0]:
        expanded, farther = try_at(-2.0)
        points[-1], values[-1] = (expanded, farther) if farther < cost else (reflected, cost)
        return 2
    if cost < values[-2]:
        points[-1], values[-1] = reflected, cost
        return 1
    if cost < values[-1]:
        points[-1], values[-1] = reflected, cost
    contracted, nearer = try_at(0.5)
    if nearer < values[-1]:
        points[-1], values[-1] = contracted, nearer
        return 2
    points[1:] = 0.5 * (points[1:] + points[0])
    values[1:] = [function(point) for point in points[1:]]
    return 2 + len(values) - 1

"""Finds the nearest of many points, with the threads of compiled loops.

SciPy's tree takes 2 microseconds for a query among 53,000 points; this one, of boxes, takes 0.5. A grid of cubic cells
lets compiled loops find all neighbours of a point.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int64

from pipeline.compute.threads import in_threads
from pipeline.geometry.nearest_kernels import LEAF, Tree, find_nearest, sort_into_tree


@dataclass(frozen=True, slots=True, eq=False)
class PointTree:
    """Holds ``points`` of space or of a plane, sorted so that the nearest are found quickly."""

    points: Float[np.ndarray, "n d"]
    tree: Tree

    @classmethod
    def of(cls, points: Float[np.ndarray, "n d"]) -> "PointTree":
        """Sorts points into a tree."""
        levels = max(0, int(np.ceil(np.log2(max(len(points), 1) / LEAF))))
        placed = _in_space(points)
        row, boxes = sort_into_tree(placed, levels)
        return cls(points, Tree(placed[row], row, boxes, levels))


def nearest(
    tree: PointTree, places: Float[np.ndarray, "n d"], *, count: int = 1, within: float = np.inf
) -> tuple[Float[np.ndarray, "n ..."], Int[np.ndarray, "n ..."]]:
    """Returns the distances and rows of the ``count`` points of the tree nearest to each place, the nearest first, with
    an axis for the count if that is more than 1.

    Of equally distant points, the one with the lower row comes first. Where fewer points are nearer than ``within``,
    the distance is infinite and the row is the number of points.
    """
    distance, row = np.empty((len(places), count)), np.empty((len(places), count), np.int64)
    placed = _in_space(places)

    def find(first: int, last: int) -> None:
        find_nearest(tree.tree, placed, within, distance, row, first, last)

    in_threads(len(places), find)
    return (distance[:, 0], row[:, 0]) if count == 1 else (distance, row)


def _in_space(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 3"]:
    """Returns the points as new rows of three numbers; points of a plane get a third coordinate 0."""
    placed = np.zeros((len(points), 3))
    placed[:, : points.shape[1]] = points
    return placed


class Cells(NamedTuple):
    """Holds points sorted by the cell of a grid that they lie in. ``order`` sorts the points; ``keys`` are their cells'
    numbers, sorted; ``spans`` is the number of cells along each axis. Outermost cells are empty, so the neighbours of a
    cell are at fixed differences in number."""

    order: Int64[np.ndarray, " n"]
    keys: Int64[np.ndarray, " n"]
    spans: Int64[np.ndarray, " 3"]


def sorted_into_cells(points: Float[np.ndarray, "n 3"], wide: float) -> Cells:
    """Sorts points into cubic cells with edge ``wide``, in the unit of the points."""
    cell = np.floor((points - points.min(axis=0)) / wide).astype(np.int64) + 1
    spans = cell.max(axis=0) + 2
    keys = (cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2]
    order = np.argsort(keys, kind="stable")
    return Cells(order, keys[order], spans)

"""Sorts points into cubic cells, so that compiled loops find neighbours quickly."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64


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

"""Points sorted into cubic cells, so that compiled loops find what lies near."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64


class Cells(NamedTuple):
    """Sorts points into cells: ``order`` sorts the points by ``keys`` (given sorted): the rank of their cell in a box
    of ``spans`` cells, whose outermost cells are empty. The neighbours of a cell are at fixed steps of the key."""

    order: Int64[np.ndarray, " n"]
    keys: Int64[np.ndarray, " n"]
    spans: Int64[np.ndarray, " 3"]


def sorted_into_cells(points: Float[np.ndarray, "n 3"], wide: float) -> Cells:
    """Returns the points in cells as ``wide`` as given, in the unit of the points."""
    cell = np.floor((points - points.min(axis=0)) / wide).astype(np.int64) + 1
    spans = cell.max(axis=0) + 2
    keys = (cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2]
    order = np.argsort(keys, kind="stable")
    return Cells(order, keys[order], spans)

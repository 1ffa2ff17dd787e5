"""Finds the nearest of many points, with the threads that compiled loops share."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from pipeline.compute.threads import in_threads


def nearest(
    tree: KDTree, points: Float[np.ndarray, "n d"], *, count: int = 1, within: float = np.inf
) -> tuple[Float[np.ndarray, "n ..."], Int[np.ndarray, "n ..."]]:
    """Returns the distances and rows of the ``count`` points of the tree nearest to each query point, as ``tree.query``
    does.

    Unlike the ``workers`` of SciPy it uses this program's own threads: those start anew at every call and add to the
    running ones.
    """
    shape = (len(points),) if count == 1 else (len(points), count)
    distance, row = np.empty(shape), np.empty(shape, np.intp)

    def query(first: int, last: int) -> None:  # lets go of the interpreter
        part = points[first:last]
        distance[first:last], row[first:last] = tree.query(part, k=count, distance_upper_bound=within)

    in_threads(len(points), query)
    return distance, row

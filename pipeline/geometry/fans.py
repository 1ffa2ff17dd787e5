"""Finds the faces at each vertex of a mesh."""

import numpy as np
from jaxtyping import Int, Int64

from pipeline.geometry.fans_kernels import sort_corners


def corners_at_vertices(
    faces: Int[np.ndarray, "f 3"], count: int
) -> tuple[Int64[np.ndarray, " v1"], Int64[np.ndarray, " e"]]:
    """Returns the corners of faces at each of ``count`` vertices as compressed rows, ``start`` and ``corner``: those of
    vertex i are ``corner[start[i]:start[i + 1]]``. Corner 3 f + k is the k-th of face f."""
    return sort_corners(np.array(faces, np.int32, order="C"), count)

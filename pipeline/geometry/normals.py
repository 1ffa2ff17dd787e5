"""Compares the normals of a mesh with the direction to a place."""

import numpy as np
from jaxtyping import Float

from pipeline.geometry.normals_kernels import cosines_towards


def facing_cosine(
    place: Float[np.ndarray, " 3"], points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Returns the cosine between the unit normal of each point and the direction from there to a place."""
    return cosines_towards(
        np.ascontiguousarray(place, float), np.ascontiguousarray(points, float), np.ascontiguousarray(normals, float)
    )

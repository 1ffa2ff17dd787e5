"""Spreads light within skin: diffuse shading, blurred over millimetres, red the most (Jensen et al. 2001)."""

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

from rig.mesh import face_normals


def scattered(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    irradiance: Float[np.ndarray, "v 3"],
    scattering_mm: tuple[float, float, float],
) -> Float[np.ndarray, "v 3"]:
    """Spreads light within the skin, by one implicit step of heat flow on the surface for each channel. The sum of the
    light over the surface stays the same; a channel with 0 mm is unchanged.

    Args:
        vertices: mm.
        faces: of a surface whose triangles may be degenerate.
        irradiance: linear RGB.
        scattering_mm: standard deviation over which each channel spreads.
    """
    stiffness, mass = _laplacian(vertices, faces)
    found = irradiance.copy()
    for channel, spread_mm in enumerate(scattering_mm):
        if spread_mm > 0.0:
            matrix = sparse.csc_array(sparse.diags_array(mass) + 0.5 * spread_mm**2 * stiffness)
            found[:, channel] = splu(matrix).solve(mass * irradiance[:, channel])
    return found


def _laplacian(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[sparse.csr_array, Float[np.ndarray, " v"]]:
    """Cotangent stiffness (positive semidefinite) and a third of the triangles' area at each vertex (mm2)."""
    double = np.maximum(np.linalg.norm(face_normals(vertices, faces), axis=1), 1e-6)
    rows, columns, values = [], [], []
    for corner in range(3):
        i, j, k = (faces[:, (corner + step) % 3] for step in (1, 2, 0))
        cotangent = ((vertices[i] - vertices[k]) * (vertices[j] - vertices[k])).sum(axis=1) / double
        half = 0.5 * np.clip(cotangent, 0.0, 20.0)  # obtuse corners would let light grow
        rows += [i, j, i, j]
        columns += [i, j, j, i]
        values += [half, half, -half, -half]
    count = len(vertices)
    at = (np.concatenate(rows), np.concatenate(columns))
    stiffness = sparse.csr_array((np.concatenate(values), at), shape=(count, count))
    mass = np.bincount(faces.ravel(), np.repeat(double / 6.0, 3), count)
    return stiffness, np.maximum(mass, 1e-6)

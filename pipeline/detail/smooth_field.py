"""Defines a displacement that varies smoothly along a head's surface: a Gaussian random field with a sparse precision
matrix.

The field follows Lindgren, Rue and Lindstroem (2011), *An explicit link between Gaussian fields and Gaussian Markov
random fields* (https://doi.org/10.1111/j.1467-9868.2011.00777.x). The solution of ``(kappa^2 - Laplace) tau x = white
noise`` on a surface is a Matern field with nu = 1 and standard deviation ``1 / (sqrt(4 pi) kappa tau)``. The field's
correlation falls to 0.14 at ``sqrt(8) / kappa``. With linear finite elements, lumped masses M and stiffness S,

    precision = tau^2 K M^-1 K,    K = kappa^2 M + S.

The field here has unit variance; the displacement is the field times an amplitude at each vertex. Beside observed
regions the field continues the observed displacement and fades to zero over ``length_mm = 1 / kappa``.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

MIN_AREA = 1e-3  # of the mean triangle: a sliver must not tear its corners from the rest
MAX_COTANGENT = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class SmoothField:
    """Holds a Matern field of unit variance on the v vertices of a mesh."""

    operator: sparse.csr_array  # K, (v, v), symmetric
    mass: Float[np.ndarray, " v"]  # mm^2
    length_mm: float

    @property
    def precision_scale(self) -> float:
        """Returns tau^2, the factor that gives the field unit variance."""
        return self.length_mm**2 / (4.0 * np.pi)

    def draw(self, rng: np.random.Generator, count: int) -> Float[np.ndarray, "v n"]:
        """Returns ``count`` random draws of the field, one in each column."""
        noise = rng.standard_normal((len(self.mass), count)) / np.sqrt(self.mass)[:, None]
        return np.sqrt(self.precision_scale) * (self.operator @ noise)

    def precision(self) -> sparse.csr_array:
        """Returns the precision matrix (v, v) of the field, tau^2 K M^-1 K."""
        return sparse.csr_array(
            self.precision_scale * (self.operator @ sparse.diags_array(1.0 / self.mass) @ self.operator)
        )


def smooth_field(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], length_mm: float) -> SmoothField:
    """Returns the random field on a mesh (mm). The cotangents of the mesh's angles are limited, so that the precision
    matrix stays positive definite."""
    count = len(vertices)
    mass = np.zeros(count)
    corners = vertices[faces]
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    double_area = np.maximum(double_area, MIN_AREA * double_area.mean())
    rows, columns, values = [], [], []
    for k in range(3):
        i, j = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        a, b = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        half = np.clip(0.5 * (a * b).sum(axis=1) / double_area, 0.0, MAX_COTANGENT)
        rows += [i, j]
        columns += [j, i]
        values += [half, half]
        mass += np.bincount(faces[:, k], double_area / 6.0, count)
    mass = np.maximum(mass, MIN_AREA * mass.mean())
    shape = (count, count)
    beside = sparse.csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape)
    stiffness = sparse.diags_array(beside.sum(axis=1)) - beside
    return SmoothField(sparse.csr_array(sparse.diags_array(mass / length_mm**2) + stiffness), mass, length_mm)

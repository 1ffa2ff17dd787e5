"""Builds a prior of heads for registration, which allows more heads than a model's own span.

A PCA of 138 heads has 137 directions, and a new head needs others: alone, on heads outside its span, it pulls vertices
to wrong positions. Two facts are known besides the sample. A head and its mirror image are equally likely, so the
covariance is averaged with its mirror image. And distant parts of a head are nearly independent, so the covariance is
multiplied by a Gaussian of the distance between vertices, which keeps the correlation of neighbours and frees the rest
(localised Gaussian process morphable models, Luethi et al. 2018, *Gaussian Process Morphable Models*, section 3.3). The
prior is a mixture of the plain and the localised covariance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from rig.mesh import edges_of

GLOBAL, LOCAL = 0.8, 0.6  # factors of both parts' standard deviations; their squares add up to 1
LENGTH_MM = 60.0  # of the Gaussian of the distance between vertices
# Localised modes; with 300 the held-out error is a tenth larger (tests/laboratory/notes/head-models.md).
KEPT = 700
_SPARE = 100  # directions of the sketch beyond those kept
_BLOCK = 600
_MIRROR = np.array([-1.0, 1.0, 1.0])
_SYMMETRIC = 0.99  # share of edges that must exist mirrored too; not all do, since quads may be split differently


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Holds a distribution of heads (mm): mean + z modes with z ~ N(0, I). Modes need not be orthogonal; the first
    ``broad`` ones are global, the others localised."""

    mean: Float[np.ndarray, "V 3"]
    modes: Float32[np.ndarray, "K V 3"]
    broad: int


def registration_prior(
    mean: Float[np.ndarray, "V 3"], modes: Float[np.ndarray, "M V 3"], faces: Int[np.ndarray, "F 3"], *, seed: int = 0
) -> Prior:
    """Returns the mixture for a model's mean and modes (mm per sigma), mirrored if the mesh is symmetric."""
    opposite = mirror_images(mean, faces)
    if opposite is not None:
        mean = (mean + mean[opposite] * _MIRROR) / 2
        modes = np.concatenate([modes, modes[:, opposite] * _MIRROR]) / np.sqrt(2)
    modes = modes.astype(np.float32)
    local = localised(mean, modes, seed=seed)
    return Prior(mean, np.concatenate([GLOBAL * modes, LOCAL * local]).astype(np.float32), len(modes))


def mirror_images(mean: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " V"] | None:
    """Returns for each vertex its counterpart across the median plane x = 0; None if the mesh is not symmetric.

    It is the cheapest one-to-one assignment. A mean head is not quite symmetric, so the nearest mirrored vertex would
    be used twice for some."""
    opposite = linear_sum_assignment(cdist(mean, mean * _MIRROR, "sqeuclidean"))[1]
    edges = edges_of(faces)[0].astype(np.int64)
    across = np.sort(opposite[edges], 1)
    found = np.isin(across[:, 0] * len(mean) + across[:, 1], edges[:, 0] * len(mean) + edges[:, 1])
    return opposite if found.mean() > _SYMMETRIC else None


def localised(
    mean: Float[np.ndarray, "V 3"], modes: Float32[np.ndarray, "M V 3"], *, seed: int = 0
) -> Float32[np.ndarray, "K V 3"]:
    """Returns the ``KEPT`` strongest modes of the covariance multiplied by a Gaussian of the distance on the mean head.

    That product K is too large to store (400 MB), so its rows are computed in blocks and multiplied once by a random
    sketch: K ~ Y (P^T Y)^-1 Y^T with Y = K P (Halko, Martinsson, Tropp 2011, section 5.5)."""
    size = mean.size
    flat = modes.reshape(len(modes), size)
    probe = np.random.default_rng(seed).standard_normal((size, min(KEPT + _SPARE, size))).astype(np.float32)
    sketch = np.empty_like(probe)
    for first in range(0, len(mean), _BLOCK):
        rows = slice(first, first + _BLOCK)
        window = np.exp(cdist(mean[rows], mean, "sqeuclidean") / (-2 * LENGTH_MM**2)).astype(np.float32)
        entries = slice(3 * first, 3 * (first + len(window)))
        product = (flat[:, entries].T @ flat).reshape(len(window), 3, len(mean), 3) * window[:, None, :, None]
        sketch[entries] = product.reshape(3 * len(window), size) @ probe
    core = probe.T.astype(float) @ sketch
    ridge = 1e-6 * np.trace(core) / len(core)  # rounding makes the smallest eigenvalues negative
    factor = cholesky((core + core.T) / 2 + ridge * np.eye(len(core)))
    root = solve_triangular(factor.T, sketch.T.astype(float), lower=True)
    values, vectors = np.linalg.eigh(root @ root.T)
    strongest = np.argsort(values)[::-1][:KEPT]
    return (vectors[:, strongest].T @ root).reshape(-1, *mean.shape).astype(np.float32)

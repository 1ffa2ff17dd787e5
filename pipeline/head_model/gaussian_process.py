"""Adds modes that let the solver leave the span of the eigenheads: smooth deformations that need not occur in the
population.

It is a Gaussian process on the mean surface, as in Gaussian process morphable models (Luethi et al. 2018,
https://doi.org/10.1109/TPAMI.2017.2739743): displacement along the mean's normal with the covariance

    k(x, y) = sum_i a_i^2 [ (1 - f) (g_i(x, y) + g_i(x, My)) + f g_i(x, y) ],
    g_i(x, y) = exp(-|x - y|^2 / (2 l_i^2)),

where M mirrors at the median plane: faces deviate from their population mostly symmetrically. Its leading
eigenfunctions (Nystroem's method on a subset of the cage) are scaled by their standard deviations and appended to the
eigenheads as modes with unit prior, orthogonal to the span of the eigenheads. They move along the normal only, since
sliding along the surface changes no silhouette.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from pipeline.compute.array_cache import cached_arrays
from pipeline.head_model.model import HeadModel, with_expressions, with_modes
from pipeline.settings import Settings
from rig.mesh import vertex_normals

NODES = 700  # of Nystroem's method; an l of 18 mm has about 250 independent places on a head
KEPT = 0.98  # share of the process's variance that the modes must carry


@dataclass(frozen=True, slots=True)
class KernelScale:
    """Holds the length and the amplitude (mm) of one Gaussian in the covariance of the Gaussian process."""

    length_mm: float
    amplitude_mm: float


# Measured on captures of heads outside the population (tests/laboratory/notes/captures.md): the residual of 60 modes of
# a MakeHuman population has about these two scales.
SCALES = (KernelScale(40.0, 2.0), KernelScale(18.0, 1.2))
FREE = 0.4  # share of the variance that need not be symmetric


def with_kernel(
    model: HeadModel, count: int, *, scales: tuple[KernelScale, ...] = SCALES, most: int = 300
) -> HeadModel:
    """Returns the model with its first ``count`` eigenheads as modes, followed by at most ``most`` modes of the
    Gaussian process (mm per standard deviation)."""
    span = with_modes(model, count)
    modes = kernel_modes(span, scales, most)
    sigma = np.linalg.norm(modes.reshape(len(modes), -1), axis=1).astype(np.float32)
    return replace(
        span, modes=np.concatenate([span.modes, modes]), sigma=np.concatenate([span.sigma, sigma]), _bases={}
    )


def with_fine_kernel(model: HeadModel, *, length_mm: float, amplitude_mm: float, most: int = 400) -> HeadModel:
    """Returns the model with additional modes of a shorter length that deform only the face region, for solvers that
    see more of the face than its outline.

    The modes fade out over half a length beyond the region. They are not orthogonal to the other modes, because the
    prior variances of all lengths should add up.
    """
    level = model.levels["cage"]
    points = model.mean.astype(float)
    inside = np.flatnonzero(level.face_region)
    nodes = inside[spread_nodes(points[inside], min(NODES, len(inside)))]
    values, vectors = np.linalg.eigh(_gaussian(points[nodes], points[nodes], length_mm, amplitude_mm))
    order = np.argsort(values)[::-1]
    share = np.cumsum(values[order]) / values.sum()
    order = order[: min(most, int(np.searchsorted(share, KEPT)) + 1)]
    fields = _gaussian(points, points[nodes], length_mm, amplitude_mm) @ (vectors[:, order] / np.sqrt(values[order]))
    outside, _ = KDTree(points[inside]).query(points)
    fields *= np.exp(-0.5 * (outside / (0.5 * length_mm)) ** 2)[:, None]
    modes = (fields.T[:, :, None] * vertex_normals(points, level.faces)[None]).astype(np.float32)
    sigma = np.linalg.norm(modes.reshape(len(modes), -1), axis=1).astype(np.float32)
    return replace(
        model, modes=np.concatenate([model.modes, modes]), sigma=np.concatenate([model.sigma, sigma]), _bases={}
    )


def _gaussian(
    x: Float[np.ndarray, "n 3"], y: Float[np.ndarray, "m 3"], length_mm: float, amplitude_mm: float
) -> Float[np.ndarray, "n m"]:
    return amplitude_mm**2 * np.exp(_square_distance(x, y) / (-2.0 * length_mm**2))


def kernel_modes(model: HeadModel, scales: tuple[KernelScale, ...], most: int) -> Float[np.ndarray, "r v0 3"]:
    """Returns the leading eigenfunctions of the Gaussian process: displacements of the cage's vertices along their
    normals (mm per standard deviation), orthogonal to the model's modes."""
    points = model.mean.astype(float)
    normals = vertex_normals(points, model.levels["cage"].faces)
    nodes = spread_nodes(points, min(NODES, len(points)))
    values, vectors = np.linalg.eigh(covariance(points[nodes], points[nodes], scales))
    order = np.argsort(values)[::-1]
    share = np.cumsum(values[order]) / values.sum()
    order = order[: min(most, int(np.searchsorted(share, KEPT)) + 1)]
    # Nystroem: f_k(x) = k(x, nodes) u_k / sqrt(value_k) has covariance sum_k f_k f_k^T ~ k.
    fields = covariance(points, points[nodes], scales) @ (vectors[:, order] / np.sqrt(values[order]))
    modes = (fields.T[:, :, None] * normals[None]).reshape(len(order), -1)
    span, _ = np.linalg.qr(model.modes.reshape(len(model.modes), -1).astype(float).T)
    modes -= (modes @ span) @ span.T
    return modes.reshape(len(order), -1, 3).astype(np.float32)


def covariance(
    x: Float[np.ndarray, "n 3"], y: Float[np.ndarray, "m 3"], scales: tuple[KernelScale, ...]
) -> Float[np.ndarray, "n m"]:
    """Returns the covariance k(x, y) of the displacements at points x and y (mm^2); positions in mm, head frame."""
    direct, mirrored = _square_distance(x, y), _square_distance(x, y * (-1.0, 1.0, 1.0))
    total = np.zeros_like(direct)
    for scale in scales:
        width = 2.0 * scale.length_mm**2
        near = np.exp(-direct / width)
        total += scale.amplitude_mm**2 * ((1.0 - FREE) * (near + np.exp(-mirrored / width)) + FREE * near)
    return total


def _square_distance(x: Float[np.ndarray, "n 3"], y: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n m"]:
    square = (x**2).sum(axis=1)[:, None] + (y**2).sum(axis=1)[None, :] - 2.0 * x @ y.T
    return np.maximum(square, 0.0)


def spread_nodes(points: Float[np.ndarray, "v 3"], count: int) -> Int[np.ndarray, " n"]:
    """Chooses ``count`` points that lie far from each other, by farthest-point sampling from the one with the largest
    z. Returns their indices."""
    nodes = np.empty(count, int)
    nodes[0] = int(np.argmax(points[:, 2]))
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        distance = np.minimum(distance, ((points - points[nodes[i - 1]]) ** 2).sum(axis=1))
        nodes[i] = int(np.argmax(distance))
    return nodes


def model_basis(model: HeadModel, settings: Settings) -> HeadModel:
    """Returns the model with the modes that the settings require: eigenheads alone or, if the fit may leave their span,
    eigenheads, modes of the Gaussian process, and expressions."""
    within_span = settings.detail == "span" or settings.method == "simplex"
    return basis_of(model, min(settings.fitting.modes, len(model.modes)), kernel=not within_span)


@lru_cache(maxsize=2)  # models are few, jobs are many, and others keep what they make of the same model
def basis_of(model: HeadModel, eigenheads: int, *, kernel: bool) -> HeadModel:
    """Returns the model with its first ``eigenheads`` modes and, if ``kernel``, the modes of the Gaussian process and
    the expressions after them."""
    if not kernel:
        return with_modes(model, eigenheads)
    inputs = (model.mean, model.modes[:eigenheads], model.sigma[:eigenheads], model.levels["cage"].faces)

    def make() -> dict[str, np.ndarray]:
        wider = with_kernel(model, eigenheads)
        return {"modes": wider.modes, "sigma": wider.sigma}

    arrays = cached_arrays("kernel-modes", inputs, make, made_by=(with_kernel, vertex_normals, HeadModel))
    wide = replace(with_modes(model, eigenheads), modes=arrays["modes"], sigma=arrays["sigma"], _bases={})
    return with_expressions(wide)

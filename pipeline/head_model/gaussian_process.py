"""Adds modes to a head model with which the solver can leave the span of the eigenheads: smooth deformations that need
not occur in the population.

The modes come from a Gaussian process on the mean surface, as in Gaussian process morphable models (Luethi et al. 2018,
https://doi.org/10.1109/TPAMI.2017.2739743): displacement along the mean's normal with the covariance k.

    k(x, y) = sum_i a_i^2 [ (1 - f) (g_i(x, y) + g_i(x, My)) + f g_i(x, y) ],
    g_i(x, y) = exp(-|x - y|^2 / (2 l_i^2)),

The operator M mirrors at the median plane, because faces deviate from their population mostly symmetrically. The
leading eigenfunctions of this process are computed by Nystroem's method on a subset of the vertices, scaled by their
standard deviations and appended to the eigenheads as modes with unit prior, orthogonal to the span of the eigenheads.
Displacements are along the normal only, because sliding along the surface changes no silhouette."""

from collections.abc import Callable
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
    """Holds the correlation length and the amplitude (mm) of one Gaussian in the covariance of the Gaussian process."""

    length_mm: float
    amplitude_mm: float


# Measured on captures of heads outside the population (tests/laboratory/notes/captures.md): the residual of 60 modes of
# a MakeHuman population has about these two scales.
SCALES = (KernelScale(40.0, 2.0), KernelScale(18.0, 1.2))
FREE = 0.4  # share of the variance that need not be symmetric


def with_kernel(model: HeadModel, count: int, *, most: int = 300) -> HeadModel:
    """Returns the model with its first ``count`` eigenheads, followed by at most ``most`` modes of the Gaussian
    process."""
    span = with_modes(model, count)
    points = span.mean.astype(float)
    nodes = spread_nodes(points, min(NODES, len(points)))
    fields = _leading_fields(points, points[nodes], lambda x, y: covariance(x, y, SCALES), most)
    normals = vertex_normals(points, span.levels["cage"].faces)
    modes = (fields[:, :, None] * normals[None]).reshape(len(fields), -1)
    axes, _ = np.linalg.qr(span.modes.reshape(len(span.modes), -1).astype(float).T)
    modes -= (modes @ axes) @ axes.T
    return _with_more_modes(span, modes.reshape(len(fields), -1, 3))


def with_fine_kernel(model: HeadModel, *, length_mm: float, amplitude_mm: float) -> HeadModel:
    """Returns the model with additional modes of a shorter correlation length that deform only the face region, for
    solvers that use more of the face than its outline.

    The modes fade out over half a correlation length beyond the region. The new modes are not orthogonal to the model's
    other modes, because the prior variances of all correlation lengths should add up."""
    level = model.levels["cage"]
    points = model.mean.astype(float)
    inside = points[level.face_region]
    nodes = inside[spread_nodes(inside, min(NODES, len(inside)))]

    def gaussian(x: Float[np.ndarray, "n 3"], y: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n m"]:
        return amplitude_mm**2 * np.exp(_square_distance(x, y) / (-2.0 * length_mm**2))

    outside, _ = KDTree(inside).query(points)
    fields = _leading_fields(points, nodes, gaussian, 400) * np.exp(-0.5 * (outside / (0.5 * length_mm)) ** 2)
    return _with_more_modes(model, fields[:, :, None] * vertex_normals(points, level.faces)[None])


def _leading_fields(
    points: Float[np.ndarray, "v 3"],
    nodes: Float[np.ndarray, "n 3"],
    process: Callable[[np.ndarray, np.ndarray], Float[np.ndarray, "_ _"]],
    most: int,
) -> Float[np.ndarray, "r v"]:
    """Returns at most ``most`` leading eigenfunctions of the Gaussian process with the covariance ``process``, each
    scaled by its standard deviation. Nystroem's formula is f_k(x) = k(x, nodes) u_k / sqrt(value_k); its covariance is
    sum_k f_k f_k^T ~ k."""
    values, vectors = np.linalg.eigh(process(nodes, nodes))
    order = np.argsort(values)[::-1]
    share = np.cumsum(values[order]) / values.sum()
    order = order[: min(most, int(np.searchsorted(share, KEPT)) + 1)]
    return (process(points, nodes) @ (vectors[:, order] / np.sqrt(values[order]))).T


def _with_more_modes(model: HeadModel, modes: Float[np.ndarray, "r v0 3"]) -> HeadModel:
    added = modes.astype(np.float32)
    sigma = np.linalg.norm(added.reshape(len(added), -1), axis=1).astype(np.float32)
    return replace(
        model, modes=np.concatenate([model.modes, added]), sigma=np.concatenate([model.sigma, sigma]), _bases={}
    )


def covariance(
    x: Float[np.ndarray, "n 3"], y: Float[np.ndarray, "m 3"], scales: tuple[KernelScale, ...]
) -> Float[np.ndarray, "n m"]:
    """Returns the covariance k(x, y) (mm^2) of the displacements at points x and y (head frame, mm)."""
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
    """Chooses ``count`` points that are far from each other, by farthest-point sampling that starts at the point with
    the largest z. Returns the indices of the chosen points."""
    nodes = np.empty(count, int)
    nodes[0] = int(np.argmax(points[:, 2]))
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        distance = np.minimum(distance, ((points - points[nodes[i - 1]]) ** 2).sum(axis=1))
        nodes[i] = int(np.argmax(distance))
    return nodes


def model_basis(model: HeadModel, settings: Settings) -> HeadModel:
    """Returns the model with the modes that the settings require: eigenheads alone or, if the fit may leave their span,
    also modes of the Gaussian process and expressions."""
    within_span = settings.detail == "span" or settings.method == "simplex"
    return basis_of(model, min(settings.fitting.modes, len(model.modes)), kernel=not within_span)


@lru_cache(maxsize=2)  # models are few, jobs are many, and others keep what they make of the same model
def basis_of(model: HeadModel, eigenheads: int, *, kernel: bool) -> HeadModel:
    """Returns the model with its first ``eigenheads`` modes and, if ``kernel``, also the modes of the Gaussian process
    and the expressions."""
    if not kernel:
        return with_modes(model, eigenheads)
    inputs = (model.mean, model.modes[:eigenheads], model.sigma[:eigenheads], model.levels["cage"].faces)

    def make() -> dict[str, np.ndarray]:
        wider = with_kernel(model, eigenheads)
        return {"modes": wider.modes, "sigma": wider.sigma}

    arrays = cached_arrays("kernel-modes", inputs, make, made_by=(with_kernel, vertex_normals, HeadModel))
    wide = replace(with_modes(model, eigenheads), modes=arrays["modes"], sigma=arrays["sigma"], _bases={})
    return with_expressions(wide)

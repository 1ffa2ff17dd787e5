"""Estimates the expression of a face from the deformed head.

The fit estimates expression weights with few eigenheads, from a surface that is exact to half a millimetre only. Shape
that few eigenheads cannot represent then looks like an expression, mostly at the brows and the wings of the nose. This
module therefore estimates the weights and their standard deviations again, from the deformed head (``refine``) and with
all eigenheads of the population. With X a point of the head, Y the same point on the deformed head and n its normal,

    n . (mean + sum_m z_m modes_m + sum_e w_e shapes_e + pose - Y) = noise,    z ~ N(0, 1).

The equation is solved for z, w and the pose with a robust loss. The variance of the kernel's modes is estimated too,
since with all eigenheads little deviation is left for them. The expression weights have the same prior and bounds as in
the fit (``prior_term``). The point Y is the closest point on the deformed head, so a shift along the surface has no
cost. The module does not change the head's vertices. For a head outside the population expressions would replace
missing eigenheads, so the fit's weights are kept.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.compute.array_cache import cached_arrays
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.prior_term import weight_slope
from pipeline.detail.association import Target, interpolated
from pipeline.estimation.bounded import least_within
from pipeline.head_model.model import HeadModel
from pipeline.photometric_fit.patches import thinned
from rig.mesh import vertex_normals

Points = Float[np.ndarray, "n 3"]

SPACING_MM = 2.5  # of the places that are asked
EVIDENCE = 4  # rounds in which the kernel's variance is estimated
VARIANCE_RANGE = (0.02, 4.0)
STRAYS = 1.0  # variance of a head that its population does not explain: heads of it have 0.02 to 0.4, others 4
SIGMA_MM, CORRELATED = 0.2, 2.0  # error of the displaced head, and how many neighbours share it
UNSEEN = 0.02  # information of a place that no point showed, by that of one that was
ROBUST_MM = 0.3
ROUNDS, REWEIGHTED = 2, 6  # of finding places; of the weights' prior
REACH_MM, AGREEMENT = 3.0, 0.5
HELD = 1e6  # information that holds a weight at its bound
POSE_INFORMATION = 1e-3
FIRST = 0.1  # weight at which the prior's tangent is taken first


@dataclass(frozen=True, slots=True, eq=False)
class ReadingBasis:
    """Holds sample points on the mean head's face (head frame, mm) and their displacements by each mode; the last modes
    are the expressions."""

    vertex: Int[np.ndarray, " n"]  # of the full level
    mean: Points
    modes: Float32[np.ndarray, "m n 3"]
    eigenheads: int  # the first of them; the kernel's follow
    faces: Int[np.ndarray, "f 3"]  # about the face


@lru_cache(maxsize=1)  # 10 MB; studios work with one model
def reading_basis(population: HeadModel, model: HeadModel, eigenheads: int) -> ReadingBasis:
    """Returns points on the mean face of ``population`` and their displacement by each mode. The modes are all
    eigenheads of ``population``, then the kernel modes and expressions of ``model``, which the fit used."""
    full = population.levels["full"]
    inputs = (population.sha256, population.modes, model.modes, model.posed, eigenheads, SPACING_MM)

    def make() -> dict[str, np.ndarray]:
        mean = population.vertices(np.zeros(0))
        vertex = thinned(mean, np.flatnonzero(full.face_region), SPACING_MM)
        population_modes = population.basis("full", len(population.modes), vertex)
        fitted = model.basis("full", model.posed.stop, vertex)[eigenheads:]
        return {"vertex": vertex, "mean": mean[vertex], "modes": np.concatenate([population_modes, fitted])}

    kept = cached_arrays("expression-places", inputs, make, made_by=(thinned, HeadModel))
    faces = full.faces[full.face_region[full.faces].any(axis=1)]
    faces.setflags(write=False)  # as the head's own faces are: loops are compiled for those
    return ReadingBasis(kept["vertex"], kept["mean"], kept["modes"], len(population.modes), faces)


def read_expression(
    fit: Fit,
    model: HeadModel,
    population: HeadModel,
    vertices_world: Float[np.ndarray, "v 3"],
    observed: Bool[np.ndarray, " v"],
    *,
    eigenheads: int,
) -> Fit:
    """Returns the fit with expression weights, and their standard deviations, estimated from the deformed head. Returns
    the fit unchanged if the model has no expressions, or if the population does not explain the head.

    ``fit``: the fit to the photographs. ``model``: the model with the fit's modes. ``population``: the model with all
    its eigenheads. ``vertices_world``: the deformed head, full mesh, mm. ``observed``: mask of vertices near a measured
    point of skin. ``eigenheads``: number of the fit's modes that are eigenheads.
    """
    if not len(model.posed):
        return fit
    basis, pose = reading_basis(population, model, eigenheads), fit.world_from_head
    head = (vertices_world - pose.translation) @ pose.rotation / pose.scale
    normals = vertex_normals(head, population.levels["full"].faces)
    trust = np.where(observed[basis.vertex], 1.0, UNSEEN) / (SIGMA_MM**2 * CORRELATED)
    place, normal = head[basis.vertex], normals[basis.vertex]
    here, there, deviation = place, np.ones(len(place)), np.zeros(0)
    weights = np.zeros(len(model.posed))
    for k in range(ROUNDS):
        off = ((here - place) * normal).sum(axis=1)
        information = there * trust / (1.0 + (off / ROBUST_MM) ** 2) ** 2
        weights, deviation, here, strays = _solved(basis, place, normal, information, len(weights))
        if strays > STRAYS:
            return fit
        if k < ROUNDS - 1:
            target = Target.of(head, normals, basis.faces)
            found = target.closest(here, normal, reach_mm=REACH_MM, least_agreement=AGREEMENT)
            corner, there = basis.faces[found.triangle], np.zeros(len(place))
            place, normal = place.copy(), normal.copy()
            place[found.row] = interpolated(head[corner], found.blend)
            normal[found.row] = interpolated(normals[corner], found.blend)
            there[found.row] = 1.0
    return _with_weights(fit, model, weights, deviation)


def _solved(
    basis: ReadingBasis, place: Points, normal: Points, information: Float[np.ndarray, " n"], expressions: int
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"], Points, float]:
    """Estimates the expression weights. Returns the weights, their standard deviations, the modelled points (head
    frame, mm) and the variance of the kernel's modes (MacKay 1992, as in ``posterior``)."""
    count = len(basis.modes)
    arm = place - place.mean(axis=0)
    by_mode = np.einsum("mnc,nc->nm", basis.modes, normal.astype(np.float32), optimize=True)
    pose = [np.cross(arm, normal), normal, (arm * normal).sum(axis=1, keepdims=True)]
    rows = np.concatenate([by_mode, *pose], axis=1, dtype=np.float32)
    root = np.sqrt(information)
    rows *= root.astype(np.float32)[:, None]
    matrix = (rows.T @ rows).astype(float)
    right = (root * ((place - basis.mean) * normal).sum(axis=1)) @ rows
    diagonal, first = np.arange(len(matrix)), count - expressions
    weights, smooth = slice(first, count), diagonal[basis.eigenheads : first]
    matrix[diagonal[:first], diagonal[:first]] += 1.0
    matrix[diagonal[first:count], diagonal[first:count]] += 1.0
    matrix[diagonal[count:], diagonal[count:]] += POSE_INFORMATION
    least, most = np.full(len(matrix), -np.inf), np.full(len(matrix), np.inf)
    least[weights], most[weights] = 0.0, 1.0
    found, now, variance = np.zeros(len(matrix)), np.full(expressions, FIRST), 1.0 if len(smooth) else 0.0
    covariance = matrix
    for k in range(REWEIGHTED):
        slope = -right
        slope[weights] += weight_slope(now)
        found = least_within(matrix, slope, least, most)
        now = np.maximum(found[weights], 0.0)
        if k < EVIDENCE or k == REWEIGHTED - 1:
            held = matrix.copy()
            bound = diagonal[first:count][now <= 0.0]
            held[bound, bound] += HELD  # what stays at its bound explains nothing of the others
            covariance = np.linalg.inv(held)
        if k < EVIDENCE and len(smooth):
            determined = np.clip(1.0 - np.diag(covariance)[smooth] / variance, 0.0, 1.0).sum()
            new = float(np.clip((found[smooth] ** 2).sum() / max(float(determined), 1e-9), *VARIANCE_RANGE))
            matrix[smooth, smooth] += 1.0 / new - 1.0 / variance
            variance = new
    deviation = np.sqrt(np.diag(covariance)[weights])
    moved = (found[:count].astype(np.float32) @ basis.modes.reshape(count, -1)).reshape(-1, 3)
    turn, shift, grown = found[count : count + 3], found[count + 3 : count + 6], found[count + 6]
    return now, deviation, basis.mean + moved + np.cross(turn, arm) + shift + grown * arm, variance


def _with_weights(
    fit: Fit, model: HeadModel, weights: Float[np.ndarray, " e"], deviation: Float[np.ndarray, " e"]
) -> Fit:
    """Replaces the expression weights of a fit, and scales its covariance to their standard deviations."""
    coefficients, posed = fit.coefficients.copy(), np.asarray(model.posed)
    coefficients[posed] = weights
    if fit.covariance is None:
        return replace(fit, coefficients=coefficients)
    factor = np.ones(len(fit.covariance))
    factor[posed] = deviation / np.sqrt(np.diag(fit.covariance)[posed])
    return replace(fit, coefficients=coefficients, covariance=fit.covariance * np.outer(factor, factor))

"""Lays points of a head on a surface by a rigid motion that a part of them may contradict.

Of the points with a counterpart the nearest ``share`` counts (trimmed ICP, Chetverikov et al. 2002), and among these
Tukey's biweight takes off what stands out of their scatter. A surface that faces the other way, as those of airways and
skull below the skin do, is no counterpart.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from pipeline.geometry.registration.rigid import Counterparts, fit_motion, motion_columns
from pipeline.geometry.surface_index import Hits, SurfaceIndex
from rig.geometry import RigidTransform, Similarity

PerPoint = Float[np.ndarray, " n"]
PointFlags = Bool[np.ndarray, " n"]

TUKEY = 4.685  # standard deviations at which a point no longer counts: 95 % efficient with normal errors
MIN_STD_MM = 0.01
MAX_REACH_MM, MIN_REACH_MM = 20.0, 2.0  # of counterparts, at first and in the end
FACING = 0.5  # cosine between the normals of counterparts
FACING_MM = 10.0
STEPS = 60
STILL_MM = 1e-5
CORRELATED_MM = 5.0  # radius within which errors of a dense surface go together: the matcher's windows
MIN_POINTS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Holds points (mm) of a head with their unit normals and the areas (mm2) that they stand for."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    areas: PerPoint


@dataclass(frozen=True, slots=True, eq=False)
class TrimmedFit:
    """Holds the motion onto a surface.

    ``residual_mm`` is each point's signed distance along the surface's normal, NaN without a counterpart; ``weights``
    are 0 where a point was taken off. ``covariance`` (6 x 6: turn about ``centre`` in rad, shift in mm) is that of the
    scatter, with as many independent errors as the area has patches of ``CORRELATED_MM``.
    """

    motion: RigidTransform
    residual_mm: PerPoint
    weights: PerPoint
    std_mm: float
    centre: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "6 6"]

    @property
    def kept_share(self) -> float:
        """Returns the share of the points that count."""
        return float(np.mean(self.weights > 0.0))

    def std_along(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> PerPoint:
        """Returns how far the motion's error moves points on the surface along normals: standard deviations, mm."""
        jacobian = motion_columns(points - self.centre, normals)
        return np.sqrt(np.einsum("np,pq,nq->n", jacobian, self.covariance, jacobian))


def trimmed_fit(
    patch: Patch, surface: SurfaceIndex, start: RigidTransform, *, share: float, beside: Callable[[Hits], PointFlags]
) -> TrimmedFit | None:
    """Returns the motion that lays a patch on a surface, None if fewer than ``MIN_POINTS`` have a counterpart there.

    Args:
        patch: of the head, in any frame.
        surface: that is met.
        start: the motion to begin with.
        share: of the points with a counterpart, the nearest, that count.
        beside: tells which closest points lie on an open edge of the surface.
    """
    reached = MAX_REACH_MM

    def meet(motion: Similarity, there: Float[np.ndarray, "n 3"], reach: float) -> Counterparts | None:
        nonlocal reached
        met = _met(patch, surface, motion, there, reach, share=share, beside=beside)
        if met is None:
            return None
        reached = max(0.7 * reach, MIN_REACH_MM, TUKEY * met.std_mm)
        return Counterparts(met.hits.normals, -met.residual, met.weights * patch.areas, reached)

    found = fit_motion(
        patch.points, meet, Similarity.from_rigid(start), reach_mm=MAX_REACH_MM, steps=STEPS, still_mm=STILL_MM
    )
    if found is None:
        return None
    there = found.apply(patch.points)
    met = _met(patch, surface, found, there, reached, share=share, beside=beside)
    if met is None:
        return None
    centre = np.average(there, axis=0, weights=met.weights * patch.areas)
    jacobian = motion_columns(there - centre, met.hits.normals)
    independent = met.weights * patch.areas / (np.pi * CORRELATED_MM**2)
    information = np.einsum("np,n,nq->pq", jacobian, independent, jacobian)
    covariance = met.std_mm**2 * np.linalg.pinv(information, hermitian=True)
    residual = np.where(met.valid, met.residual, np.nan)
    return TrimmedFit(
        RigidTransform(found.rotation, found.translation), residual, met.weights, met.std_mm, centre, covariance
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Met:
    """Holds the closest points of a surface, which of them are counterparts, the signed distances from them along the
    surface's normals (positive where the points lie outside), the weights, and the deviation of those that count."""

    hits: Hits
    valid: PointFlags
    residual: PerPoint
    weights: PerPoint
    std_mm: float


def _met(
    patch: Patch,
    surface: SurfaceIndex,
    motion: Similarity,
    there: Float[np.ndarray, "n 3"],
    reach: float,
    *,
    share: float,
    beside: Callable[[Hits], PointFlags],
) -> _Met | None:
    """Returns what the points meet where the motion brings them, None if fewer than ``MIN_POINTS`` do."""
    normals = patch.normals @ motion.rotation.T
    hits = surface.closest(there, facing=normals, facing_mm=FACING_MM)
    alike = np.einsum("nx,nx->n", normals, hits.normals) > FACING
    valid = (hits.distances < reach) & alike & ~beside(hits)
    if valid.sum() < MIN_POINTS:
        return None
    residual = np.einsum("nx,nx->n", there - hits.points, hits.normals)
    return _Met(hits, valid, residual, *_weights(residual, valid, share))


def _weights(residual: PerPoint, valid: PointFlags, share: float) -> tuple[PerPoint, float]:
    """Returns a weight for each point, and the standard deviation (mm) of those that count."""
    away = np.abs(residual)
    kept = valid & (away <= np.quantile(away[valid], share))
    normal = float(ndtri(0.5 + share / 4.0))  # where the middle of the nearest share of normal errors lies
    std = max(float(np.median(away[kept])) / normal, MIN_STD_MM)
    weights = np.where(kept, np.maximum(1.0 - (away / (TUKEY * std)) ** 2, 0.0) ** 2, 0.0)
    return weights, std

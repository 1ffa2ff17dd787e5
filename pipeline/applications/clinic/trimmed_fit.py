"""Lays points of a head on a surface by a rigid motion that a part of them may contradict.

Iterations of closest points with steps on distances along the surface's normals (Chen and Medioni 1992). Of the points
with a counterpart the nearest ``share`` counts (trimmed ICP, Chetverikov et al. 2002), and among these Tukey's biweight
takes off what stands out of their scatter. A surface that faces the other way, as those of airways and skull below the
skin do, is no counterpart.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from pipeline.geometry.surface_index import Hits, SurfaceIndex
from rig.geometry import RigidTransform, rotation_from_vector

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
    areas: Float[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class TrimmedFit:
    """Holds the motion onto a surface.

    ``residual_mm`` is each point's signed distance along the surface's normal, NaN without a counterpart; ``weights``
    are 0 where a point was taken off. ``covariance`` (6 x 6: turn about ``centre`` in rad, shift in mm) is that of the
    scatter, with as many independent errors as the area has patches of ``CORRELATED_MM``.
    """

    motion: RigidTransform
    residual_mm: Float[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]
    std_mm: float
    centre: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "6 6"]

    @property
    def kept_share(self) -> float:
        """Returns the share of the points that count."""
        return float(np.mean(self.weights > 0.0))

    def std_along(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns how far the motion's error moves points on the surface along normals: standard deviations, mm."""
        jacobian = np.concatenate([np.cross(points - self.centre, normals), normals], axis=1)
        return np.sqrt(np.einsum("np,pq,nq->n", jacobian, self.covariance, jacobian))


def trimmed_fit(
    patch: Patch,
    surface: SurfaceIndex,
    start: RigidTransform,
    *,
    share: float,
    beside: Callable[[Hits], Bool[np.ndarray, " n"]],
) -> TrimmedFit | None:
    """Returns the motion that lays a patch on a surface, None if fewer than ``MIN_POINTS`` have a counterpart there.

    Args:
        patch: of the head, in any frame.
        surface: that is met.
        start: the motion to begin with.
        share: of the points with a counterpart, the nearest, that count.
        beside: tells which closest points lie on an open edge of the surface.
    """
    motion, reach = start, MAX_REACH_MM
    for _ in range(STEPS):
        there = motion.apply(patch.points)
        hits, valid = _counterparts(patch, surface, motion, there, reach, beside)
        if valid.sum() < MIN_POINTS:
            return None
        residual = _residuals(hits, there)
        weights, std = _weights(residual, valid, share)
        step, centre = _step(there, hits.normals, residual, weights * patch.areas)
        turn = rotation_from_vector(step[:3])
        moved = RigidTransform(turn, centre + step[3:] - turn @ centre)
        motion = moved @ motion
        still = float(np.abs(moved.apply(there) - there).max()) < STILL_MM
        if still and reach <= max(MIN_REACH_MM, TUKEY * std):
            break
        reach = max(0.7 * reach, MIN_REACH_MM, TUKEY * std)
    return _finished(patch, surface, motion, share, reach, beside)


def _finished(
    patch: Patch,
    surface: SurfaceIndex,
    motion: RigidTransform,
    share: float,
    reach: float,
    beside: Callable[[Hits], Bool[np.ndarray, " n"]],
) -> TrimmedFit | None:
    there = motion.apply(patch.points)
    hits, valid = _counterparts(patch, surface, motion, there, reach, beside)
    if valid.sum() < MIN_POINTS:
        return None
    residual = _residuals(hits, there)
    weights, std = _weights(residual, valid, share)
    centre = np.average(there, axis=0, weights=weights * patch.areas)
    jacobian = np.concatenate([np.cross(there - centre, hits.normals), hits.normals], axis=1)
    independent = weights * patch.areas / (np.pi * CORRELATED_MM**2)
    information = np.einsum("np,n,nq->pq", jacobian, independent, jacobian)
    covariance = std**2 * np.linalg.pinv(information, hermitian=True)
    return TrimmedFit(motion, np.where(valid, residual, np.nan), weights, std, centre, covariance)


def _counterparts(
    patch: Patch,
    surface: SurfaceIndex,
    motion: RigidTransform,
    there: Float[np.ndarray, "n 3"],
    reach: float,
    beside: Callable[[Hits], Bool[np.ndarray, " n"]],
) -> tuple[Hits, Bool[np.ndarray, " n"]]:
    """Returns the closest points of the surface, and which of them are counterparts."""
    normals = patch.normals @ motion.rotation.T
    hits = surface.closest(there, facing=normals, facing_mm=FACING_MM)
    alike = np.einsum("nx,nx->n", normals, hits.normals) > FACING
    return hits, (hits.distances < reach) & alike & ~beside(hits)


def _residuals(hits: Hits, there: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns signed distances along the surface's normals, positive where the points lie outside."""
    return np.einsum("nx,nx->n", there - hits.points, hits.normals)


def _weights(
    residual: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"], share: float
) -> tuple[Float[np.ndarray, " n"], float]:
    """Returns a weight for each point, and the standard deviation (mm) of those that count."""
    away = np.abs(residual)
    kept = valid & (away <= np.quantile(away[valid], share))
    normal = float(ndtri(0.5 + share / 4.0))  # where the middle of the nearest share of normal errors lies
    std = max(float(np.median(away[kept])) / normal, MIN_STD_MM)
    weights = np.where(kept, np.maximum(1.0 - (away / (TUKEY * std)) ** 2, 0.0) ** 2, 0.0)
    return weights, std


def _step(
    there: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    residual: Float[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " 6"], Float[np.ndarray, " 3"]]:
    """Returns the turn (rad) about the weighted middle and the shift (mm) that undo the residuals, and that middle."""
    centre = np.average(there, axis=0, weights=weights)
    jacobian = np.concatenate([np.cross(there - centre, normals), normals], axis=1)
    root = np.sqrt(weights / weights.sum())
    return np.linalg.lstsq(jacobian * root[:, None], -residual * root, rcond=None)[0], centre

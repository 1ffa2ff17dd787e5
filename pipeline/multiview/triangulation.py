"""Triangulates points from their pixels in several views (the paper's section 4.2), by Gauss-Newton steps on the
reprojection error.

The input is one pixel per camera. The output is the world point with its covariance. The search starts at the point
nearest to all rays (linear least squares). The projection includes lens distortion, so pixels need not be undistorted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rig.camera import Camera
from rig.errors import EigenheadError
from rig.geometry import ray_equations
from rig.messages.message import Message, compose
from rig.rig import Rig

USUAL = 0.70  # of eleven cameras around a face: median over its patches, 0.69 to 0.70 on five captures of two renderers
MIN_PARALLAX = 0.1  # with less parallax, depth is unknown
CLICK_NOISE_PX = 1.5  # of a person's click; measured on captures rendered by another program
STEPS = 10  # three are usual
SETTLED = 1e-9  # relative decrease of the misfit at which the iteration ends
MIN_RAYS_APART = 1e-4  # rad; between rays closer to parallel, 0.1 px at f = 1500 px, depth is unknown


class NoPoint(EigenheadError):
    """Reports pixels from which no point can be triangulated."""

    def __init__(self, why: Message) -> None:
        super().__init__(compose("point-refused", reason=why))


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedPoint:
    """Holds a triangulated point (world frame, mm), its covariance (mm^2), and the residual in each view (measured
    minus projected, px)."""

    position_world: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "3 3"]
    residuals_px: Mapping[str, Float[np.ndarray, " 2"]]

    def misfit(self, noise_px: float) -> float:
        """Returns the sum of squared residuals divided by the squared noise. For correct pixels the sum is distributed
        as chi-square with ``2 * views - 3`` degrees of freedom."""
        return sum(float(r @ r) for r in self.residuals_px.values()) / noise_px**2


def triangulate(pixels: Mapping[str, Float[np.ndarray, " 2"]], rig: Rig, *, noise_px: float) -> TriangulatedPoint:
    """Computes the point that minimises the sum of squared reprojection errors over the cameras in ``pixels``.

    Args:
        pixels: the picked pixel by camera.
        rig: the cameras.
        noise_px: standard deviation of each coordinate of a picked pixel, to which the covariance scales.

    Raises NoPoint like ``triangulate_many``, and if there are fewer than two views."""
    if len(pixels) < 2:
        raise NoPoint(compose("point-in-few-views", count=len(pixels)))
    picked = np.array([np.asarray(pixel, float) for pixel in pixels.values()])[:, None]
    found = triangulate_many(picked, [rig[name] for name in pixels], np.full((len(pixels), 1), noise_px))
    residuals = dict(zip(pixels, found.residuals_px[:, 0], strict=True))
    return TriangulatedPoint(found.positions_world[0], found.covariances[0], residuals)


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedPoints:
    """Holds n triangulated points (world frame, mm), their covariances (mm^2), and the residuals in each view (measured
    minus projected, px)."""

    positions_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    residuals_px: Float[np.ndarray, "v n 2"]


def triangulate_many(
    pixels: Float[np.ndarray, "v n 2"],
    cameras: Sequence[Camera],
    noise_px: Float[np.ndarray, "v n"],
    *,
    start: Float[np.ndarray, "n 3"] | None = None,
) -> TriangulatedPoints:
    """Triangulates many points, each visible in every camera.

    Args:
        pixels: the pixel of each point in each view.
        cameras: the cameras of the views.
        noise_px: standard deviation of each coordinate of a pixel; infinite where a view does not count for a point.
        start: points near the result, if known; parallel rays are then not reported.

    Raises NoPoint if a point's rays are parallel, if it lies behind a camera, or if a pixel lies outside the valid area
    of the lens model."""
    if start is None:
        rays = np.stack([camera.rays_world(seen) for camera, seen in zip(cameras, pixels, strict=True)])
        shares = 1.0 / noise_px**2
        shares /= shares.sum(axis=0)
        start = _nearest_to_rays(np.stack([camera.centre_world for camera in cameras]), rays, shares)
    points = start
    weights = 1.0 / noise_px[..., None]
    at_points = _whitened(points, pixels, cameras, weights)
    if not np.isfinite(at_points[0]).all():
        raise NoPoint(compose("point-behind-camera"))
    for _ in range(STEPS):
        residual, slopes = at_points
        matrix = np.einsum("vnki,vnkj->nij", slopes, slopes)
        step = np.linalg.solve(matrix, -np.einsum("vnki,vnk->ni", slopes, residual)[..., None])[..., 0]
        moved = _whitened(points + step, pixels, cameras, weights)
        before, after = (residual**2).sum(axis=(0, 2)), (moved[0] ** 2).sum(axis=(0, 2))
        better = after < before
        if not better.any():
            break
        points = np.where(better[:, None], points + step, points)
        at_points = (
            np.where(better[None, :, None], moved[0], residual),
            np.where(better[None, :, None, None], moved[1], slopes),
        )
        if ((before - after)[better] <= SETTLED * before[better]).all():
            break
    covariances = np.linalg.inv(np.einsum("vnki,vnkj->nij", at_points[1], at_points[1]))
    projected = np.stack([camera.project(points) for camera in cameras])
    return TriangulatedPoints(points, covariances, pixels - projected)


def _nearest_to_rays(
    centres_world: Float[np.ndarray, "v 3"],
    rays_world: Float[np.ndarray, "v n 3"],
    weights: Float[np.ndarray, "v n"] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Returns, for each point, the position with the least weighted sum of squared distances to its rays. Raises
    NoPoint if the rays are parallel."""
    if not np.isfinite(rays_world).all():
        raise NoPoint(compose("point-outside-lens"))
    matrix, right = ray_equations(centres_world, rays_world, weights)
    if np.linalg.eigvalsh(matrix)[:, 0].min() < MIN_RAYS_APART**2:
        raise NoPoint(compose("point-rays-parallel"))
    return np.linalg.solve(matrix, right[..., None])[..., 0]


def _whitened(
    points: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "v n 2"],
    cameras: Sequence[Camera],
    weights: Float[np.ndarray, "v n 1"],
) -> tuple[Float[np.ndarray, "v n 2"], Float[np.ndarray, "v n 2 3"]]:
    """Returns the residuals ``(projected - measured) / noise`` and their derivatives; residuals are infinite for points
    behind a camera, and 0 where the weight is 0."""
    projected, slopes = zip(*(camera.project_with_jacobian(points) for camera in cameras), strict=True)
    counts = weights > 0.0
    residual = np.where(counts, weights * (np.stack(projected) - pixels), 0.0)
    slopes = np.where(counts[..., None], weights[..., None] * np.stack(slopes), 0.0)
    return np.where(np.isfinite(residual), residual, np.inf), slopes


def parallax(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    centres: Float[np.ndarray, "k 3"],
    view: Int[np.ndarray, "n v"],
    value: Float[np.ndarray, "n v"],
) -> Float[np.ndarray, " n"]:
    """Returns the parallax of points on a surface: the displacement of two views' images against each other, measured
    along the surface, for each millimetre that the surface moves along its normal. The returned parallax is the
    weighted root mean square over all pairs of views. Noise, highlights and calibration errors displace an image; this
    displacement divided by the parallax is the error in depth.

    ``points``: points on a surface, mm. ``normals``: unit normals of the surface there. ``centres``: camera centres, in
    the same frame. ``view``: the cameras that compare each point; -1 for none. ``value``: their weights; 0 for none.
    """
    towards = centres[np.maximum(view, 0)] - points[:, None]
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
    slides = towards - np.einsum("nvc,nc->nv", towards, normals)[:, :, None] * normals[:, None]
    share = value / np.maximum(value.sum(axis=1, keepdims=True), 1e-9)
    middle = np.einsum("nv,nvc->nc", share, slides)
    square = (share * ((slides - middle[:, None]) ** 2).sum(axis=2)).sum(axis=1)
    return np.sqrt(2.0 * square)


def depth_factor(found: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the ratio between the depth errors of this rig and of the usual rig (eleven cameras around a face,
    parallax ``USUAL``) for equal image errors: the ratio of the parallaxes, at least 1. ``found`` is the parallax of
    each point with this rig."""
    return USUAL / np.clip(found, MIN_PARALLAX, USUAL)

"""A point from its pixels in several views (section 4.2): Levenberg-Marquardt on the reprojection error.

Enters: one pixel per camera. Leaves: the world point with its covariance. The start is the point nearest to all rays
(linear least squares), and lens distortion is part of the projection, so nothing is undistorted first.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rig.errors import EigenheadError
from rig.layout import Rig

ITERATIONS_MOST = 50
RAYS_APART_LEAST = 1e-4  # rad; between rays closer to parallel, 0.1 px at f = 1500 px, depth is unknown


class NoPoint(EigenheadError):
    """Pixels that determine no point."""

    def __init__(self, why: str) -> None:
        super().__init__(f"{why}; pick the point again, in views that look from clearly different sides")


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedPoint:
    """A world point (mm), its covariance (mm^2), and what each view says against it (measured minus projected, px)."""

    position_world: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "3 3"]
    residuals_px: Mapping[str, Float[np.ndarray, " 2"]]

    def misfit(self, noise_px: float) -> float:
        """Sum of squared residuals in units of the noise: chi-square with ``2 * views - 3`` degrees of freedom."""
        return sum(float(r @ r) for r in self.residuals_px.values()) / noise_px**2


def triangulate(pixels: Mapping[str, Float[np.ndarray, " 2"]], rig: Rig, *, noise_px: float) -> TriangulatedPoint:
    """The point that minimises the sum of squared reprojection errors over the cameras in ``pixels``.

    ``noise_px`` is the standard deviation of a picked coordinate; it scales the covariance only. Raises NoPoint where
    fewer than two views, parallel rays or a point behind a camera leave nothing to determine.
    """
    if len(pixels) < 2:
        raise NoPoint(f"{len(pixels)} view of a point; two at least are needed")
    position = _start(pixels, rig)
    residual, jacobian = _linearise(position, pixels, rig)
    if not np.isfinite(residual).all():
        raise NoPoint("the rays of a point meet behind a camera")
    damping = 1e-3
    for _ in range(ITERATIONS_MOST):
        normal = jacobian.T @ jacobian
        # Marquardt's scaling by the diagonal: steps do not depend on the unit of length.
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), jacobian.T @ residual)
        tried_residual, tried_jacobian = _linearise(position + step, pixels, rig)
        if tried_residual @ tried_residual < residual @ residual:  # False for the NaN of a point behind a camera
            position, residual, jacobian = position + step, tried_residual, tried_jacobian
            damping *= 0.1
        else:
            damping *= 10.0
        if np.linalg.norm(step) < 1e-9 * np.linalg.norm(position - rig[next(iter(pixels))].centre_world):
            break
    covariance = noise_px**2 * np.linalg.inv(jacobian.T @ jacobian)
    return TriangulatedPoint(position, covariance, dict(zip(pixels, residual.reshape(-1, 2), strict=True)))


def _start(pixels: Mapping[str, Float[np.ndarray, " 2"]], rig: Rig) -> Float[np.ndarray, " 3"]:
    """The point with the least sum of squared distances to the rays."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for name, pixel in pixels.items():
        ray = rig[name].rays_world(np.asarray(pixel, float)[None])[0]
        off_ray = np.eye(3) - np.outer(ray, ray)
        normal += off_ray
        right += off_ray @ rig[name].centre_world
    if not np.isfinite(normal).all():
        raise NoPoint("a pixel lies where the lens model of its camera sees nothing")
    # The smallest eigenvalue is the sum of squared sines between the rays and their mean direction.
    if np.linalg.eigvalsh(normal)[0] < RAYS_APART_LEAST**2:
        raise NoPoint("the rays of a point are parallel")
    return np.linalg.solve(normal, right)


def _linearise(
    position: Float[np.ndarray, " 3"], pixels: Mapping[str, Float[np.ndarray, " 2"]], rig: Rig
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r 3"]]:
    """Measured minus projected pixels, and the derivative of the projection."""
    views = [rig[name].project_with_jacobian(position[None]) for name in pixels]
    projected = np.concatenate([pixel[0] for pixel, _ in views])
    return np.concatenate([np.asarray(p, float) for p in pixels.values()]) - projected, np.concatenate(
        [j[0] for _, j in views]
    )

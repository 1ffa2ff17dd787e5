"""Computes the residual of a frontier point in two cameras, and its derivatives by both cameras.

A plane through two camera centres that touches the subject touches both silhouettes, at the images of one frontier
point (Ramanathan, Steinbach and Girod 2000; Wong and Cipolla 2001). Each silhouette's tangent pixel gives one plane
through both centres. With centres c, rays d at the two tangent pixels and base b = c2 - c1, the angle between the two
planes is

    delta = |b| b . (d1 x d2) / (|b x d1| |b x d2|)

The residual of a tangency is the angle delta divided by the change of angle per pixel in both images together. The
residual is the distance (px) by which each of two equally noisy contours would have to move. At a tangent point the
contour runs along the plane, so to first order the tangent pixels do not move along it when a camera moves. With x' =
R(w) x + v in camera 1's frame,

    d delta ~ w . (R1 (d2 x b)) x R1 d1 + v . R1 (d1 x d2)         and likewise, signs swapped, for camera 2.

Central differences give the derivative by the logarithm of a focal length, which rotates the rays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Residuals
from pipeline.multiview.tangency import Tangency
from rig.camera import Camera
from rig.rig import Rig

ROBUST_SIGMAS = 3.0  # scale of Geman and McClure's loss, in standard deviations
ZOOM_STEP = 1e-4  # difference of a focal length's logarithm for its derivative


@dataclass(frozen=True, slots=True, eq=False)
class PackedTangencies:
    """Holds n tangencies of a rig as arrays. ``steepness`` is the change of angle per pixel of both contours together
    (rad / px)."""

    cameras: Int[np.ndarray, "n 2"]
    pixels: Float[np.ndarray, "n 2 2"]
    steepness: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, tangencies: Sequence[Tangency], rig: Rig) -> "PackedTangencies":
        """Packs tangencies whose cameras are all in ``rig``."""
        index = {name: k for k, name in enumerate(rig.names)}
        return cls(
            np.array([[index[name] for name in t.cameras] for t in tangencies], int).reshape(-1, 2),
            np.array([t.pixels for t in tangencies], float).reshape(-1, 2, 2),
            np.array([np.hypot(*t.steepness) for t in tangencies], float),
        )


@dataclass(frozen=True, slots=True, eq=False)
class TangencyTerm:
    """Computes Geman and McClure's cost of tangency residuals as a function of the corrections of all cameras.

    A correction holds, for each camera, a left perturbation of its pose in ``start`` (rad, mm). With ``focal``, a
    correction also holds the change of the focal length's logarithm."""

    seen: PackedTangencies
    start: Rig
    focal: bool
    noise_px: float

    def at(self, correction: Float[np.ndarray, " p"]) -> Residuals:
        """Returns the residuals, in standard deviations, and their derivatives at a correction."""
        rig = corrected(self.start, correction, focal=self.focal)
        residual_px = tangency_residuals(self.seen, rig)
        return Residuals(
            residual_px[:, None] / self.noise_px,
            lambda: tangency_jacobian(self.seen, rig, focal=self.focal)[:, None] / self.noise_px,
            GemanMcClure(ROBUST_SIGMAS),
        )


def per_camera(*, focal: bool) -> int:
    """Returns the number of unknowns of a camera: 6 for its pose, and with ``focal`` 1 more."""
    return 7 if focal else 6


def corrected(rig: Rig, correction: Float[np.ndarray, " p"], *, focal: bool) -> Rig:
    """Applies a correction to the pose of every camera and, with ``focal``, to its focal length."""
    cameras = []
    for camera, step in zip(rig, correction.reshape(len(rig), -1), strict=True):
        moved = camera.moved(step[:6])
        cameras.append(zoomed(moved, float(step[6])) if focal else moved)
    return Rig(tuple(cameras))


def zoomed(camera: Camera, log_scale: float) -> Camera:
    """Returns the camera with both focal lengths multiplied by ``exp(log_scale)``."""
    lens, scale = camera.intrinsics, float(np.exp(log_scale))
    return replace(camera, intrinsics=replace(lens, fx=lens.fx * scale, fy=lens.fy * scale))


def tangency_residuals(packed: PackedTangencies, rig: Rig) -> Float[np.ndarray, " n"]:
    """Returns the residuals (px), as defined in the module's docstring."""
    base, rays = _bases(packed, rig), _rays(packed, rig)
    across = np.cross(rays[:, 0], rays[:, 1])
    return _gain(packed, base, rays) * (base * across).sum(axis=1)


def tangency_jacobian(packed: PackedTangencies, rig: Rig, *, focal: bool) -> Float[np.ndarray, "n p"]:
    """Returns the derivatives of the residuals by the corrections of all cameras (px per rad, mm and unit of the
    logarithm). The factor that converts angles to pixels is treated as constant."""
    size, count = per_camera(focal=focal), len(packed.cameras)
    base, rays = _bases(packed, rig), _rays(packed, rig)
    gain = _gain(packed, base, rays)[:, None]
    across = np.cross(rays[:, 0], rays[:, 1])
    turns = np.stack([camera.camera_from_world.rotation for camera in rig])
    rows = np.zeros((count, len(rig), size))
    for side, by_ray, by_centre in ((0, np.cross(rays[:, 1], base), across), (1, np.cross(base, rays[:, 0]), -across)):
        camera = packed.cameras[:, side]
        by_ray_inside, ray_inside, by_centre_inside = (
            np.einsum("nij,nj->ni", turns[camera], vector) for vector in (by_ray, rays[:, side], by_centre)
        )
        rows[np.arange(count), camera, :3] = gain * np.cross(by_ray_inside, ray_inside)
        rows[np.arange(count), camera, 3:6] = gain * by_centre_inside
        if focal:
            wider, narrower = (_rays(packed, Rig(tuple(zoomed(c, s * ZOOM_STEP) for c in rig))) for s in (1.0, -1.0))
            widening = (wider[:, side] - narrower[:, side]) / (2.0 * ZOOM_STEP)
            rows[np.arange(count), camera, 6] = gain[:, 0] * (by_ray * widening).sum(axis=1)
    return rows.reshape(count, -1)


def _bases(packed: PackedTangencies, rig: Rig) -> Float[np.ndarray, "n 3"]:
    """Returns the vectors from the first camera's centre to the second's (mm)."""
    centres = np.stack([camera.centre_world for camera in rig])
    return centres[packed.cameras[:, 1]] - centres[packed.cameras[:, 0]]


def _rays(packed: PackedTangencies, rig: Rig) -> Float[np.ndarray, "n 2 3"]:
    """Returns unit rays through both tangent pixels, in the world frame."""
    rays = np.empty((*packed.cameras.shape, 3))
    for k, camera in enumerate(rig):
        here = packed.cameras == k
        rays[here] = camera.rays_world(packed.pixels[here])
    return rays


def _gain(
    packed: PackedTangencies, base: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 2 3"]
) -> Float[np.ndarray, " n"]:
    """Returns the factor that converts the triple product ``b . (d1 x d2)`` to pixels."""
    planes = [np.linalg.norm(np.cross(base, rays[:, side]), axis=1) for side in (0, 1)]
    return np.linalg.norm(base, axis=1) / (planes[0] * planes[1] * packed.steepness)

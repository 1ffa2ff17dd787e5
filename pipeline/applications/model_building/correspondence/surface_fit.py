"""Fits a model directly to a surface: Gauss-Newton on point-to-plane distances, pose and coefficients together.

It measures the best fit that a model can reach (tests/laboratory/notes/head-models.md), transfers landmarks from one
model to another, and starts correspondence. Point-to-plane steps follow Chen and Medioni (1992); the prior is
z ~ N(0, I)."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.registration.rigid import motion_about, motion_columns, solve_with_prior
from pipeline.geometry.surface_index import Hits, SurfaceIndex
from pipeline.head_model.model import HeadModel
from rig.geometry import RigidTransform

_STEP_MM = 5e-3  # mean move of a step at which the iteration ends


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """Holds the head of a model that fits a surface best."""

    coefficients: Float[np.ndarray, " m"]  # standard deviations
    target_from_head: RigidTransform
    distances: Float[np.ndarray, " N"]  # mm, of each point to the fitted surface
    iterations: int

    def vertices(self, model: HeadModel, level: str = "full") -> Float[np.ndarray, "V 3"]:
        """Returns the fitted head in the target's frame."""
        return self.target_from_head.apply(model.vertices(self.coefficients, level))

    def measured(self, model: HeadModel, points: Float[np.ndarray, "N 3"], level: str = "full") -> "SurfaceFit":
        """Returns the same fit with the distances of other points."""
        index = SurfaceIndex(self.vertices(model, level), model.levels[level].faces)
        return replace(self, distances=index.closest(points).distances)


def fit_surface(
    model: HeadModel,
    points: Float[np.ndarray, "N 3"],
    weights: Float[np.ndarray, " N"],
    start: RigidTransform,
    count: int,
    *,
    sigma_mm: float = 0.5,
    spread_mm: float = 10.0,
    level: str = "full",
    iterations: int = 40,
) -> SurfaceFit:
    """Estimates the pose and ``count`` coefficients that bring the model's surface to the points, under the prior.

    ``weights`` are the areas (mm²) that the points represent. Residuals of neighbouring points are not independent, so
    one residual of standard deviation ``sigma_mm`` counts per ``spread_mm`` squared of surface. The first iterations
    fit only the pose and few modes and downweight distant points (Geman and McClure), so that a rough start does not
    distort the head."""
    basis = model.basis(level, count)
    faces = model.levels[level].faces
    z, pose = np.zeros(count), start
    information = weights / spread_mm**2 / sigma_mm**2
    used = 0
    for step in range(iterations):
        active = count if step >= 8 else (0, 0, 0, 5, 5, 15, 15, 30)[step]
        hits = _closest(model, z, pose, level, faces, points)
        scale = max(3.0 * float(np.median(hits.distances)), 3.0 * sigma_mm) if step < 12 else np.inf
        robust = (1 + (hits.distances / scale) ** 2) ** -2
        few, normals, centre = basis[:active], hits.normals, points.mean(0)
        turned = normals @ pose.rotation  # n^T R
        along = np.einsum("mncx,nc,nx->nm", few[:, faces[hits.triangles]], hits.weights, turned, optimize=True)
        columns = np.concatenate([along, motion_columns(hits.points - centre, normals)], axis=1)
        ahead, prior = np.einsum("nx,nx->n", points - hits.points, normals), np.repeat([1.0, 0.0], [len(few), 6])
        state = np.concatenate([z[: len(few)], np.zeros(6)])
        delta = solve_with_prior(columns, ahead, information * robust, prior, state)
        z[: len(few)] += delta[: len(few)]
        moved = motion_about(centre, delta[len(few) :]) @ pose
        pose, used = RigidTransform(moved.rotation, moved.translation), step + 1
        if step > 12 and float(np.abs(columns @ delta).mean()) < _STEP_MM:
            break
    return SurfaceFit(z, pose, _closest(model, z, pose, level, faces, points).distances, used)


def _closest(
    model: HeadModel,
    z: Float[np.ndarray, " m"],
    pose: RigidTransform,
    level: str,
    faces: Int[np.ndarray, "F 3"],
    points: Float[np.ndarray, "N 3"],
) -> Hits:
    return SurfaceIndex(pose.apply(model.vertices(z, level)), faces).closest(points)

"""Defines rigid transforms and similarities between frames, and functions on rotations, rays and parabolas."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float

Values = TypeVar("Values", float, np.ndarray)


@dataclass(frozen=True, slots=True, eq=False)
class RigidTransform:
    """Maps coordinates in frame a to frame b: ``x_b = rotation @ x_a + translation`` (mm)."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]

    @classmethod
    def identity(cls) -> "RigidTransform":
        """Returns the identity transform."""
        return cls(np.eye(3), np.zeros(3))

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> "RigidTransform":
        """Returns the inverse, a_from_b, which maps coordinates in frame b to frame a."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Returns the points (mm) in frame b."""
        return points @ self.rotation.T + self.translation


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """Maps coordinates in frame a to frame b: ``x_b = scale * rotation @ x_a + translation`` (mm).

    The paper writes the similarity as ``T(x) = s (R x + t')``, with t = s t'."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]

    @classmethod
    def identity(cls) -> "Similarity":
        """Returns the identity similarity."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def from_rigid(cls, transform: RigidTransform) -> "Similarity":
        """Returns ``transform`` as a similarity of scale 1."""
        return cls(1.0, transform.rotation, transform.translation)

    def __matmul__(self, other: "Similarity | RigidTransform") -> "Similarity":
        inner = other.scale if isinstance(other, Similarity) else 1.0
        return Similarity(self.scale * inner, self.rotation @ other.rotation, self.apply(other.translation))

    def inverse(self) -> "Similarity":
        """Returns the inverse, a_from_b, which maps coordinates in frame b to frame a."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def apply(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Returns the points (mm) in frame b."""
        return self.scale * (points @ self.rotation.T) + self.translation


def cross_matrix(vector: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Returns the matrix ``[v]x``, so that ``cross_matrix(v) @ w == cross(v, w)``."""
    matrix = np.zeros((*vector.shape[:-1], 3, 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    matrix[..., 0, 1], matrix[..., 0, 2] = -z, y
    matrix[..., 1, 0], matrix[..., 1, 2] = z, -x
    matrix[..., 2, 0], matrix[..., 2, 1] = -y, x
    return matrix


def rotation_from_vector(vector: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Returns the matrix of a rotation about the axis ``vector`` by ``|vector|`` radians (Rodrigues' formula)."""
    angle = np.sqrt((vector * vector).sum(axis=-1))[..., None, None]
    skew = cross_matrix(vector)
    # Below 1e-4 rad the series keeps full precision where sin(a)/a and (1-cos a)/a^2 lose digits.
    safe = np.maximum(angle, 1e-4)
    first = np.where(angle > 1e-4, np.sin(safe) / safe, 1.0 - angle**2 / 6.0)
    second = np.where(angle > 1e-4, (1.0 - np.cos(safe)) / safe**2, 0.5 - angle**2 / 24.0)
    return np.eye(3) + first * skew + second * (skew @ skew)


def vector_from_rotation(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """Returns the axis of a rotation matrix, multiplied by its angle (rad) in [0, pi]."""
    # Through the unit quaternion (x, y, z, w): the largest of its four squared entries is at least 1/4, so that the
    # division below is safe at every angle, pi included.
    r = rotation
    trace = np.trace(r)
    products = np.array(
        [
            [1 + 2 * r[0, 0] - trace, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], 1 + 2 * r[1, 1] - trace, r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 + 2 * r[2, 2] - trace, r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + trace],
        ]
    )
    row = products[np.argmax(np.diag(products))]
    x, y, z, w = row / np.linalg.norm(row)
    axis, w = np.array([x, y, z]) * np.copysign(1.0, w), abs(w)
    sine = float(np.linalg.norm(axis))
    return axis * (2.0 * np.arctan2(sine, w) / sine if sine > 1e-12 else 2.0)


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation closest to ``matrix`` in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def rigid_fit(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None
) -> RigidTransform:
    """Estimates target_from_source by weighted least squares (Kabsch 1976). The default weights are equal.

    The result is the rigid transform T, without reflection, that minimises ``sum_j w_j |target_j - T(source_j)|^2``."""
    share = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = share @ source, share @ target
    rotation = nearest_rotation(((source - source_mean) * share[:, None]).T @ (target - target_mean)).T
    return RigidTransform(rotation, target_mean - rotation @ source_mean)


def nearest_to_rays(
    centres: Float[np.ndarray, "v 3"],
    rays: Float[np.ndarray, "v ... 3"],
    weights: Float[np.ndarray, "v ..."] | None = None,
    ridge: float = 1e-9,
) -> Float[np.ndarray, "... 3"]:
    """Returns each point (mm) with the least weighted sum of squared distances to its rays, one ray from each centre.

    Args:
        centres: where the rays begin (mm).
        rays: unit directions, for each centre and point.
        weights: 0 where a centre has no ray for a point; equal by default.
        ridge: added to the diagonal of the equations, which parallel rays leave singular.
    """
    matrix, right = ray_equations(centres, rays, weights)
    return np.linalg.solve(matrix + ridge * np.eye(3), right[..., None])[..., 0]


def ray_equations(
    centres: Float[np.ndarray, "v 3"],
    rays: Float[np.ndarray, "v ... 3"],
    weights: Float[np.ndarray, "v ..."] | None = None,
) -> tuple[Float[np.ndarray, "... 3 3"], Float[np.ndarray, "... 3"]]:
    """Returns the matrix and right side of the linear equations that ``nearest_to_rays`` solves. The smallest
    eigenvalue of the matrix is the sum of squared sines of the angles between the rays and their mean direction."""
    weights = np.ones(rays.shape[:-1]) if weights is None else weights
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    matrix = np.einsum("v...,v...ij->...ij", weights, across)
    return matrix, np.einsum("v...,v...ij,vj->...i", weights, across, centres)


def look_at(
    centre: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]
) -> RigidTransform:
    """Computes camera_from_world of a camera at ``centre`` (mm) whose optical axis passes through ``target`` (mm). The
    direction ``up`` points to the top of its image."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return RigidTransform(rotation, -rotation @ centre)


def second_difference(before: Values, middle: Values, after: Values) -> Values:
    """Returns the second derivative of the parabola through three equidistant values, per step squared."""
    return before - 2.0 * middle + after


def vertex_offset(before: Values, after: Values, curvature: Values) -> Values:
    """Returns the position of the vertex of the parabola through three equidistant values, in steps from the middle
    value towards ``after``.

    Args:
        before: the value one step before the middle one.
        after: the value one step behind the middle one.
        curvature: ``second_difference`` of the three. It must not be 0; callers bound it by the noise of their values.
    """
    return 0.5 * (before - after) / curvature

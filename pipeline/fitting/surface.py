"""What is known of the surface itself, as against its rim: point-to-plane observations for the same normal equations.

An observation says that a vertex of the full level lies ``displacement`` mm along a normal from where it stood when it
was observed, with an information (mm^-2). Sliding along the surface is free, as for the rim. Where it came from images,
it leans on the cameras: moving camera k by c_k moves the observed place by ``by_camera . c_k``, and what the images say
of the cameras alone (shifts between them that no surface explains) stands in ``camera_matrix``. With

    e = n . (X(theta) - X_seen) - displacement - by_camera . (c - c_seen)

the term is ``sum information rho(e) + (c - c_seen)^T M (c - c_seen) - 2 g^T (c - c_seen)``, rho of Geman and McClure
with a scale of ``FORGIVEN_SIGMAS``.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from rig.geometry import Similarity

FORGIVEN_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceObservations:
    """n observations of vertices of the full level; K cameras in the order of the solver's views."""

    vertex: Int[np.ndarray, " n"]
    basis: Float32[np.ndarray, "m n 3"]  # the model's modes at those vertices, head frame
    mean: Float[np.ndarray, "n 3"]  # the mean head there
    normal: Float[np.ndarray, "n 3"]  # world, unit
    seen_at: Float[np.ndarray, "n 3"]  # world, mm: where the vertex stood
    displacement: Float[np.ndarray, " n"]  # mm along the normal
    information: Float[np.ndarray, " n"]  # mm^-2
    by_camera: Float[np.ndarray, "n c"]  # c = 6 K
    camera_shift: Float[np.ndarray, "k 6"]  # when observed
    camera_matrix: Float[np.ndarray, "c c"]
    camera_gradient: Float[np.ndarray, " c"]


def surface_residual(
    seen: SurfaceObservations,
    coefficients: Float[np.ndarray, " m"],
    world_from_head: Similarity,
    camera_shift: Float[np.ndarray, "k 6"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """e (mm), and where the vertices are now (world)."""
    count = len(coefficients)
    moved = (coefficients.astype(np.float32) @ seen.basis[:count].reshape(count, -1)).reshape(-1, 3)
    points = world_from_head.apply(seen.mean + moved)
    along = ((points - seen.seen_at) * seen.normal).sum(axis=1)
    return along - seen.displacement - seen.by_camera @ (camera_shift - seen.camera_shift).ravel(), points


def surface_cost(
    seen: SurfaceObservations,
    coefficients: Float[np.ndarray, " m"],
    world_from_head: Similarity,
    camera_shift: Float[np.ndarray, "k 6"],
) -> float:
    residual, _ = surface_residual(seen, coefficients, world_from_head, camera_shift)
    square = seen.information * residual**2
    moved = (camera_shift - seen.camera_shift).ravel()
    cameras = float(moved @ seen.camera_matrix @ moved - 2.0 * seen.camera_gradient @ moved)
    return float((square / (1.0 + square / FORGIVEN_SIGMAS**2)).sum()) + cameras


def surface_weights(seen: SurfaceObservations, residual: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Information (mm^-2) that the robust cost leaves to each observation."""
    return seen.information / (1.0 + seen.information * residual**2 / FORGIVEN_SIGMAS**2) ** 2


def surface_equations(
    seen: SurfaceObservations,
    coefficients: Float[np.ndarray, " m"],
    world_from_head: Similarity,
    camera_shift: Float[np.ndarray, "k 6"],
    *,
    cameras: bool,
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """The term's part of J^T W J and J^T W r over (coefficients, pose, cameras where they are solved for)."""
    residual, points = surface_residual(seen, coefficients, world_from_head, camera_shift)
    rows = surface_rows(seen, len(coefficients), world_from_head, points, cameras=cameras)
    root = np.sqrt(surface_weights(seen, residual))
    rows *= root.astype(np.float32)[:, None]
    matrix, gradient = (rows.T @ rows).astype(float), (root * residual) @ rows  # A^T A: half the work of A^T B
    if cameras:
        tail = slice(len(gradient) - seen.by_camera.shape[1], None)
        matrix[tail, tail] += seen.camera_matrix
        gradient[tail] += seen.camera_matrix @ (camera_shift - seen.camera_shift).ravel() - seen.camera_gradient
    return matrix, gradient


def surface_rows(
    seen: SurfaceObservations,
    count: int,
    world_from_head: Similarity,
    points: Float[np.ndarray, "n 3"],
    *,
    cameras: bool,
) -> Float32[np.ndarray, "n p"]:
    """de / d(coefficients, rotation, translation, log scale, cameras)."""
    turned = (world_from_head.scale * (seen.normal @ world_from_head.rotation)).astype(np.float32)
    shape = np.einsum("nc,mnc->nm", turned, seen.basis[:count], optimize=True)
    arm = points - world_from_head.translation
    blocks = [shape, np.cross(arm, seen.normal), seen.normal, (arm * seen.normal).sum(axis=1, keepdims=True)]
    if cameras:
        blocks.append(-seen.by_camera)
    return np.concatenate(blocks, axis=1, dtype=np.float32)

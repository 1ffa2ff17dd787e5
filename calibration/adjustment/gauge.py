"""Computes errors of cameras without the part that no image can determine: the arbitrary choice of the world frame.

A rig that moves as a whole stays the same rig. So two calibrations are compared, and covariances stated, in the gauge
in which the images of the subject's region move least. Let ``W`` (6 C x 6 C, block-diagonal) be the sum of ``J^T J``
over points on a sphere of the subject's size, with ``J`` the derivative of a pixel by a left perturbation of
camera_from_world, and let ``A`` (6 C x 6) be the motions of all cameras under a motion of the world. Then the
projection is ``S = I - A (A^T W A)^-1 A^T W`` (an S-transformation: W. Baarda, 1973; Triggs et al., "Bundle Adjustment:
A Modern Synthesis", section 9).

The world frame of a calibrated rig has x to the subject's left, y up, z towards the front camera. Up is the direction
perpendicular to the cameras' image rows: a camera that is not rolled has a horizontal x axis at any elevation. The
origin is the point nearest to all optical axes."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.terms import Problem, Residuals
from rig.camera import Camera, lens_jacobians
from rig.errors import InputError
from rig.geometry import RigidTransform, cross_matrix, nearest_rotation, rotation_from_vector
from rig.messages.message import compose
from rig.rig import Rig

SUBJECT_RADIUS_MM = 110.0  # of a sphere as large as a head


def subject_points(rig: Rig, radius_mm: float = SUBJECT_RADIUS_MM, count: int = 60) -> Float[np.ndarray, "n 3"]:
    """Returns points (mm) spread evenly over a sphere around the point that the cameras see (a Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    height, angle = 1 - 2 * index / count, np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - height**2)
    return rig.centre_world() + radius_mm * np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)


def pose_jacobian(camera: Camera, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 6"]:
    """Returns the derivative of the points' pixels by a left perturbation of camera_from_world (px per rad and mm)."""
    _, by_world = camera.project_with_jacobian(points_world)
    by_camera = by_world @ camera.camera_from_world.rotation.T
    points = camera.camera_from_world.apply(points_world)
    return np.concatenate([-by_camera @ cross_matrix(points), by_camera], axis=2)


def image_metric(rig: Rig, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "c 6 6"]:
    """Returns, for each camera, the matrix Q with which p^T Q p is the mean squared image motion (px^2) of
    ``points_world`` under the pose perturbation p."""
    metrics = []
    for camera in rig:
        jacobian = pose_jacobian(camera, points_world)
        jacobian = jacobian[np.isfinite(jacobian).all(axis=(1, 2))]
        metrics.append(np.einsum("nij,nik->jk", jacobian, jacobian) / max(1, len(jacobian)))
    return np.stack(metrics)


def world_motions(rig: Rig, *, scale: bool = False) -> Float[np.ndarray, "p g"]:
    """Returns the left perturbations of all cameras (rows) that correspond to a rotation, a translation and, with
    ``scale``, a scaling of the world (columns)."""
    columns = []
    for camera in rig:
        rotation, translation = camera.camera_from_world.rotation, camera.camera_from_world.translation
        # camera_from_world @ motion: x' = R (W x + m) + t = (R W R^T)(x_c - t) + R m + t.
        turn = np.concatenate([rotation, cross_matrix(translation) @ rotation])
        shift = np.concatenate([np.zeros((3, 3)), rotation])
        block = [turn, shift]
        if scale:  # a larger world: points x (1 + s) are seen as before by cameras whose t grows the same
            block.append(np.concatenate([np.zeros(3), translation])[:, None])
        columns.append(np.concatenate(block, axis=1))
    return np.concatenate(columns)


def gauge_projection(rig: Rig, *, scale: bool = False) -> Float[np.ndarray, "p p"]:
    """Returns the projection S, defined in the module's docstring. With ``scale`` the world's scale is free too."""
    weights = _block_diagonal(image_metric(rig, subject_points(rig)))
    motions = world_motions(rig, scale=scale)
    normal = motions.T @ weights @ motions
    return np.eye(len(motions)) - motions @ np.linalg.solve(normal, motions.T @ weights)


def _block_diagonal(blocks: Float[np.ndarray, "c 6 6"]) -> Float[np.ndarray, "p p"]:
    count = len(blocks)
    matrix = np.zeros((count, 6, count, 6))
    matrix[np.arange(count), :, np.arange(count)] = blocks
    return matrix.reshape(6 * count, 6 * count)


def align_world(rig: Rig, reference: Rig, *, scale: bool = False) -> Rig:
    """Returns ``rig`` with its world moved (and scaled, with ``scale``) so that its images of the subject's region are
    as near as possible to those of ``reference``.

    The distances in the images are minimised, starting from the mean motion between the cameras' frames."""
    points = subject_points(reference)
    target = np.concatenate([reference[camera.name].project(points) for camera in rig])
    problem = Problem((_ImageTerm(points, target, scale),), 7 if scale else 6, _shifted)
    return minimise(
        problem, _brought_together(rig, reference), Limits(steps=12, tolerance=1e-18, first_damping=0.0)
    ).value


@dataclass(frozen=True, slots=True, eq=False)
class _ImageTerm:
    """Computes the distances (px) of the rig's images of the points from ``target``; 0 outside a lens's valid area."""

    points: Float[np.ndarray, "n 3"]
    target: Float[np.ndarray, "m 2"]
    scale: bool

    def at(self, rig: Rig) -> Residuals:
        moves = world_motions(rig, scale=self.scale).reshape(len(rig), 6, -1)
        rows = np.concatenate([pose_jacobian(c, self.points) @ m for c, m in zip(rig, moves, strict=True)])
        miss = np.concatenate([camera.project(self.points) for camera in rig]) - self.target
        good = np.asarray(np.isfinite(miss).all(axis=1) & np.isfinite(rows).all(axis=(1, 2)))
        return Residuals(np.where(good[:, None], miss, 0.0), lambda: np.where(good[:, None, None], rows, 0.0))


def _shifted(rig: Rig, step: np.ndarray) -> Rig:
    """Returns the rig with poses ``camera_from_world @ motion``; a seventh entry of ``step`` scales the
    translations."""
    motion = RigidTransform(rotation_from_vector(step[:3]), step[3:6])
    cameras = []
    for camera in rig:
        pose = camera.camera_from_world
        if len(step) > 6:
            pose = replace(pose, translation=pose.translation * (1 + step[6]))
        cameras.append(replace(camera, camera_from_world=pose @ motion))
    return Rig(tuple(cameras))


def _brought_together(rig: Rig, reference: Rig) -> Rig:
    """Returns the rig with its world moved by the mean of the motions that take its cameras' frames to those of
    ``reference``."""
    moves = [camera.camera_from_world.inverse() @ reference[camera.name].camera_from_world for camera in rig]
    rotation = nearest_rotation(np.sum([move.rotation for move in moves], axis=0))
    here = np.mean([camera.centre_world for camera in rig], axis=0)
    reference_centre = np.mean([reference[camera.name].centre_world for camera in rig], axis=0)
    motion = RigidTransform(rotation, here - rotation @ reference_centre)
    return Rig(tuple(replace(camera, camera_from_world=camera.camera_from_world @ motion) for camera in rig))


def image_distance(rig: Rig, reference: Rig, *, scale: bool = False) -> Float[np.ndarray, " c"]:
    """Computes, for each camera, the RMS distance (px) between the images of the subject's region in ``rig`` and in
    ``reference``, with aligned worlds.

    It measures a calibration error by its effect on a fit to silhouettes. Each rig projects with its own lenses, so
    errors of principal point and rotation that cancel do not count."""
    points = subject_points(reference)
    aligned = align_world(rig, reference, scale=scale)
    misses = [camera.project(points) - reference[camera.name].project(points) for camera in aligned]
    return np.array([np.sqrt(np.nanmean((miss**2).sum(axis=1))) for miss in misses])


def intrinsics_jacobian(camera: Camera, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 9"]:
    """Returns the derivative of the points' pixels by fx fy cx cy k1 k2 p1 p2 k3."""
    return lens_jacobians(camera.camera_from_world.apply(points_world), camera.intrinsics.values())[1]


def effective_pose(camera: Camera, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "6 15"]:
    """Returns the matrix that converts an error of the intrinsics (first nine) and pose of a camera to the pose
    perturbation with the most similar effect on the subject's image.

    Whoever treats the intrinsics as exact must allow the pose that error: a principal point that is 10 px off, for
    example, acts almost like a rotation."""
    by_pose = pose_jacobian(camera, points_world).reshape(-1, 6)
    by_lens = intrinsics_jacobian(camera, points_world).reshape(-1, 9)
    good = np.isfinite(by_pose).all(axis=1) & np.isfinite(by_lens).all(axis=1)
    absorbed = np.linalg.lstsq(by_pose[good], by_lens[good], rcond=None)[0]
    return np.concatenate([absorbed, np.eye(6)], axis=1)


def image_sigma(rig: Rig, covariance: Float[np.ndarray, "c 15 c 15"]) -> Float[np.ndarray, " c"]:
    """Computes, for each camera, the standard deviation (px, 2D) of its image of the subject's region, with aligned
    worlds, under the joint covariance of all intrinsics (first nine) and poses. It estimates ``image_distance(rig, true
    rig)``."""
    points, count = subject_points(rig), len(rig)
    by_pose = [pose_jacobian(camera, points).reshape(-1, 6) for camera in rig]
    by_lens = [intrinsics_jacobian(camera, points).reshape(-1, 9) for camera in rig]
    values, vectors = np.linalg.eigh(covariance.reshape(15 * count, 15 * count))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).reshape(count, 15, -1)
    motions = world_motions(rig).reshape(count, 6, 6)
    images = np.concatenate([np.hstack([k, p]) @ r for k, p, r in zip(by_lens, by_pose, root, strict=True)])
    free = np.concatenate([p @ m for p, m in zip(by_pose, motions, strict=True)])
    lost = ~(np.isfinite(images).all(axis=1) & np.isfinite(free).all(axis=1))
    images[lost], free[lost] = 0.0, 0.0
    basis = np.linalg.qr(free)[0]
    images = images - basis @ (basis.T @ images)
    squares = (images**2).sum(axis=1).reshape(count, -1, 2).sum(axis=2)
    return np.sqrt(squares.mean(axis=1))


def up_direction(rig: Rig) -> Float[np.ndarray, " 3"]:
    """Returns the upward unit vector, in the rig's present frame."""
    rights = np.stack([camera.camera_from_world.rotation[0] for camera in rig])
    ups = -np.stack([camera.camera_from_world.rotation[1] for camera in rig])
    values, vectors = np.linalg.eigh(rights.T @ rights)
    mean = ups.mean(axis=0)
    # Two small eigenvalues: all rows are parallel, so a whole plane of directions is perpendicular to them.
    spread = vectors[:, :1] if values[1] > 0.05 * values[2] else vectors[:, :2]
    up = spread @ (spread.T @ mean)
    return up / np.linalg.norm(up)


def in_world_frame(rig: Rig, front: str | None = None) -> Rig:
    """Returns the same rig in the project's world frame. ``front`` names the front camera; by default it is the middle
    one.

    Covariances are those of left perturbations and do not change. Raises InputError if ``front`` is no camera of the
    rig."""
    if front is not None and front not in rig:
        raise InputError("front camera", [compose("front-of-other-rig", front=f"{front!r}", cameras=rig.names)])
    origin, up = rig.centre_world(), up_direction(rig)
    forward = rig[front or rig.front_camera()].centre_world - origin
    forward = forward - up * (up @ forward)
    forward /= np.linalg.norm(forward)
    new_from_old = np.stack([np.cross(up, forward), up, forward])
    old_from_new = RigidTransform(new_from_old.T, origin)
    return Rig(tuple(replace(camera, camera_from_world=camera.camera_from_world @ old_from_new) for camera in rig))

"""Computes errors of cameras that do not depend on the arbitrary choice of the world frame, which no image determines.

Moving all cameras together changes no image. Calibrations are therefore compared in the gauge (choice of world frame)
in which the images of the subject's region move least. Let ``W`` (6 C x 6 C, block-diagonal) be the sum of ``J^T J``
over points on a sphere of the subject's size, with ``J`` the derivative of a pixel by a left perturbation of
camera_from_world, and let ``A`` (6 C x 6) be the motions of all cameras under a motion of the world. The projection on
this gauge is ``S = I - A (A^T W A)^-1 A^T W`` (an S-transformation: W. Baarda, 1973; Triggs et al., "Bundle Adjustment:
A Modern Synthesis", section 9).

The world frame of a calibrated rig has x to the subject's left, y up, and z towards the front camera. The up direction
is perpendicular to the image rows of all cameras, because a camera without roll has a horizontal x axis. The world's
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
    """Returns points (mm) of a Fibonacci lattice on a sphere around the point nearest to all optical axes."""
    index = np.arange(count) + 0.5
    height, angle = 1 - 2 * index / count, np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - height**2)
    return rig.centre_world() + radius_mm * np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)


def pose_jacobian(camera: Camera, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 6"]:
    """Returns the derivative of the points' pixels by a left perturbation of camera_from_world (px/rad, px/mm)."""
    _, by_world = camera.project_with_jacobian(points_world)
    by_camera = by_world @ camera.camera_from_world.rotation.T
    points = camera.camera_from_world.apply(points_world)
    return np.concatenate([-by_camera @ cross_matrix(points), by_camera], axis=2)


def image_metric(rig: Rig, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "c 6 6"]:
    """Returns a matrix Q for each camera. For a pose perturbation p, ``p^T Q p`` is the mean squared image motion
    (px^2) of ``points_world``."""
    metrics = []
    for camera in rig:
        jacobian = pose_jacobian(camera, points_world)
        jacobian = jacobian[np.isfinite(jacobian).all(axis=(1, 2))]
        metrics.append(np.einsum("nij,nik->jk", jacobian, jacobian) / max(1, len(jacobian)))
    return np.stack(metrics)


def world_motions(rig: Rig, *, scale: bool = False) -> Float[np.ndarray, "p g"]:
    """Returns the left perturbations of all camera poses (rows) under each rotation and translation of the world
    (columns). ``scale`` adds a column for a scaling of the world."""
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
    """Returns the projection S of the module's docstring. With ``scale``, S also removes errors of scale."""
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
    """Moves the world frame of ``rig`` so that its images of the subject's region are as near as possible to the images
    in ``reference``. With ``scale``, the rig's world is also scaled.

    The distances in the images are minimised, starting from the mean motion between the cameras' frames."""
    points = subject_points(reference)
    target = np.concatenate([reference[camera.name].project(points) for camera in rig])
    problem = Problem((_ImageTerm(points, target, scale),), 7 if scale else 6, _shifted)
    return minimise(
        problem, _brought_together(rig, reference), Limits(steps=12, tolerance=1e-18, first_damping=0.0)
    ).value


@dataclass(frozen=True, slots=True, eq=False)
class _ImageTerm:
    """Computes the distances (px) of the points' images from ``target``, or 0 outside a lens's valid area."""

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
    """Returns the rig with its world moved by ``step``; a seventh entry of ``step`` scales the translations."""
    motion = RigidTransform(rotation_from_vector(step[:3]), step[3:6])
    cameras = []
    for camera in rig:
        pose = camera.camera_from_world
        if len(step) > 6:
            pose = replace(pose, translation=pose.translation * (1 + step[6]))
        cameras.append(replace(camera, camera_from_world=pose @ motion))
    return Rig(tuple(cameras))


def _brought_together(rig: Rig, reference: Rig) -> Rig:
    """Moves the rig's world by the mean of the motions from its cameras' frames to those in ``reference``."""
    moves = [camera.camera_from_world.inverse() @ reference[camera.name].camera_from_world for camera in rig]
    rotation = nearest_rotation(np.sum([move.rotation for move in moves], axis=0))
    here = np.mean([camera.centre_world for camera in rig], axis=0)
    reference_centre = np.mean([reference[camera.name].centre_world for camera in rig], axis=0)
    motion = RigidTransform(rotation, here - rotation @ reference_centre)
    return Rig(tuple(replace(camera, camera_from_world=camera.camera_from_world @ motion) for camera in rig))


def image_distance(rig: Rig, reference: Rig, *, scale: bool = False) -> Float[np.ndarray, " c"]:
    """Computes, for each camera, the RMS distance (px) between images of the subject's region in ``rig`` and in
    ``reference``, after aligning their worlds.

    The distance measures a calibration error by its effect on a fit to silhouettes. Each rig projects with its own
    lenses, so an error of the principal point that a rotation compensates does not count."""
    points = subject_points(reference)
    aligned = align_world(rig, reference, scale=scale)
    misses = [camera.project(points) - reference[camera.name].project(points) for camera in aligned]
    return np.array([np.sqrt(np.nanmean((miss**2).sum(axis=1))) for miss in misses])


def intrinsics_jacobian(camera: Camera, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 9"]:
    """Returns the derivative of the points' pixels by fx fy cx cy k1 k2 p1 p2 k3."""
    return lens_jacobians(camera.camera_from_world.apply(points_world), camera.intrinsics.values())[1]


def effective_pose(camera: Camera, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "6 15"]:
    """Returns the matrix that converts an error of a camera's nine intrinsics and pose to the pose perturbation with
    the most similar effect on the subject's image.

    A fit that treats the intrinsics as exact must allow for this error in the pose. A principal point that is 10 px off
    acts almost like a rotation of the camera."""
    by_pose = pose_jacobian(camera, points_world).reshape(-1, 6)
    by_lens = intrinsics_jacobian(camera, points_world).reshape(-1, 9)
    good = np.isfinite(by_pose).all(axis=1) & np.isfinite(by_lens).all(axis=1)
    absorbed = np.linalg.lstsq(by_pose[good], by_lens[good], rcond=None)[0]
    return np.concatenate([absorbed, np.eye(6)], axis=1)


def image_sigma(rig: Rig, covariance: Float[np.ndarray, "c 15 c 15"]) -> Float[np.ndarray, " c"]:
    """Computes, for each camera, the standard deviation (px, 2D) of its image of the subject's region, after aligning
    worlds. ``covariance`` is the joint covariance of each camera's nine intrinsics and pose. The
    standard deviation estimates ``image_distance`` from the rig to the true rig."""
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
    """Returns the upward unit vector, in the rig's current world frame."""
    rights = np.stack([camera.camera_from_world.rotation[0] for camera in rig])
    ups = -np.stack([camera.camera_from_world.rotation[1] for camera in rig])
    values, vectors = np.linalg.eigh(rights.T @ rights)
    mean = ups.mean(axis=0)
    # Two small eigenvalues: all rows are parallel, so a whole plane of directions is perpendicular to them.
    spread = vectors[:, :1] if values[1] > 0.05 * values[2] else vectors[:, :2]
    up = spread @ (spread.T @ mean)
    return up / np.linalg.norm(up)


def in_world_frame(rig: Rig, front: str | None = None) -> Rig:
    """Returns the same rig in the world frame of the module's docstring. ``front`` names the front camera; the default
    is the middle camera.

    The covariances, of left perturbations, do not change. Raises InputError if the rig has no camera ``front``."""
    if front is not None and front not in rig:
        raise InputError("front camera", [compose("front-of-other-rig", front=f"{front!r}", cameras=rig.names)])
    origin, up = rig.centre_world(), up_direction(rig)
    forward = rig[front or rig.front_camera()].centre_world - origin
    forward = forward - up * (up @ forward)
    forward /= np.linalg.norm(forward)
    new_from_old = np.stack([np.cross(up, forward), up, forward])
    old_from_new = RigidTransform(new_from_old.T, origin)
    return Rig(tuple(replace(camera, camera_from_world=camera.camera_from_world @ old_from_new) for camera in rig))

"""Estimates the pose of a face that only one view shows, from the mean adult's points.

Enters: a detection and its camera. Leaves: world_from_face, and the points with the uncertainty that one view leaves.
On rendered captures the face is turned by 5 degrees against the result of all views (median, up to 75 degrees from the
camera; 17 for profiles). Its distance follows from its size: 9 % off (RMS), 24 % for profiles, plus the difference
between the subject's and the mean adult's head.
"""

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import FaceDetection
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.points import point_table
from pipeline.faces.triangulated_face import point_noise_px, unbiased_px, view_noise_px
from rig.camera import Camera
from rig.geometry import RigidTransform, Similarity, rotation_from_vector

ROUNDS = 3  # of the pose, and the bias that follows from it
DISTANCE_SHARE = 0.1  # standard deviation of the distance, by itself: measured, and by how heads differ
TURN_RAD = 0.1  # the same of the turn about each axis
MIN_COSINE = 0.2  # of the angle from a point's normal to the camera: those that it sees


def place_from_one_view(face: FaceDetection, camera: Camera) -> Similarity | None:
    """Returns the pose (world_from_face, scale 1) in which a mean adult's points project to where one camera found
    them. Returns None if no pose explains the points, or if they lie outside the lens."""
    shape, pixels = point_table().shape_mm, face.landmarks_px
    seen = np.ones(len(shape), bool)
    placed: Similarity | None = None
    for _ in range(ROUNDS):
        pose = _pose(shape[seen], camera.undistort(pixels[seen]))
        if pose is None:
            return None
        placed = Similarity.from_rigid(camera.camera_from_world.inverse() @ pose)
        pixels = unbiased_px(face, placed, camera)
        towards = camera.centre_world - placed.apply(shape)
        normals = point_table().normals @ placed.rotation.T
        seen = (normals * towards).sum(axis=1) > MIN_COSINE * np.linalg.norm(towards, axis=1)
    return placed


def match_alone(name: str, face: FaceDetection, camera: Camera) -> MatchedFaces | None:
    """Returns a face that only one view shows in the form of ``matching``, with a mean adult's points. Returns None
    where ``place_from_one_view`` does.

    The pixels determine the points across the line of sight. What they leave open moves all points together: along
    their rays, and about the middle of the face.
    """
    placed = place_from_one_view(face, camera)
    if placed is None:
        return None
    points = placed.apply(point_table().shape_mm)
    noise_px, view_px = (
        point_noise_px(face.size_px, points, placed, camera),
        view_noise_px(face.size_px, placed, camera),
    )
    along = points - camera.centre_world
    px_mm = np.linalg.norm(along, axis=1) / camera.intrinsics.fx
    turns = TURN_RAD * np.cross(np.eye(3)[:, None], (points - points.mean(axis=0))[None])
    across = view_px * px_mm[None, :, None] * camera.camera_from_world.rotation[:2, None]
    return MatchedFaces(
        detections={name: face},
        outliers={},
        pixels={name: unbiased_px(face, placed, camera)},
        noise_px={name: noise_px},
        view_noise_px={name: view_px},
        points_world=points,
        covariances=((noise_px * px_mm) ** 2)[:, None, None] * np.eye(3),
        shared_mm=np.concatenate([DISTANCE_SHARE * along[None], turns, across]),
        residuals_px={name: unbiased_px(face, placed, camera) - camera.project(points)},
        world_from_face=placed,
        relief=1.0,
    )


def _pose(points: Float[np.ndarray, "n 3"], normalised: Float[np.ndarray, "n 2"]) -> RigidTransform | None:
    """camera_from_face of points and where they are seen (X / Z, Y / Z), by the least sum of squares."""
    if len(points) < 6 or not np.isfinite(normalised).all():
        return None
    found, turn, shift = cv2.solvePnP(points, normalised, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP)
    if not found or shift[2, 0] <= 0.0:
        return None
    turn, shift = cv2.solvePnPRefineLM(points, normalised, np.eye(3), np.zeros(5), turn, shift)
    return RigidTransform(rotation_from_vector(turn.ravel()), shift.ravel())

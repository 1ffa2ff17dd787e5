"""Measures how far a delivered face is turned and shifted from the truth: the rigid motion that takes the one to the
other.

If both have the same vertices, these correspond (Kabsch 1976). Otherwise the motion starts from landmarks, whose
positions on a head are known whatever its direction, and is refined on distances along the truth's normals (Chen and
Medioni 1992) over the face. Closest points alone would lay a face that looks backwards on the back of the true head and
call it right, so that a refinement that moves away from its landmarks is discarded.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.landmarks import SEVEN_POINTS
from rig.geometry import RigidTransform, rigid_fit, rotation_from_vector, vector_from_rotation

POINTS = 1500  # of the face: six numbers need no more
STEPS = 25
STILL_MM, STILL_RAD = 1e-3, 1e-5  # a smaller step is the last
NEAREST_SHARE = 0.8  # of the points, those nearest to the truth: a wrong shape of the rest does not turn the face
MAX_REFINED_DEG, MAX_REFINED_MM = 8.0, 10.0  # from where the landmarks say, which are right to 2.6 degrees and 4.2 mm
LANDMARK_MM = 3.0  # standard deviation of a landmark's place against the same landmark of another model
SURFACE_MM = 1.0  # the same of a point of the face against the true surface, all of them together worth as many
# landmarks
SURFACE_WORTH = 60.0  # observations that the face's points count as, for they err alike: of heads whose shape is 0.8 mm
# off, 0.32 degrees and 0.21 mm; landmarks alone 1.32 and 1.11, the surface all but alone 0.30 and 0.27; of heads 2.8 mm
# off 1.01 and 0.44, 2.06 and 2.14, 1.13 and 1.16


@dataclass(frozen=True, slots=True, eq=False)
class PoseError:
    """Holds the error of a pose: the motion from the delivered face to the true one, its angle, and how far it moves
    the middle of the delivered face."""

    truth_from_result: RigidTransform
    turn_deg: float
    shift_mm: float


def pose_error_of_vertices(result: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"]) -> PoseError:
    """Computes the pose error of a face (world frame, mm) from vertices that correspond."""
    return _describe(rigid_fit(result, truth), result.mean(axis=0))


def pose_error_of_surfaces(
    face: Float[np.ndarray, "n 3"],
    landmarks: Mapping[str, Float[np.ndarray, " 3"]],
    truth: SurfaceIndex,
    true_landmarks: Mapping[str, Float[np.ndarray, " 3"]],
) -> PoseError:
    """Computes the pose error of a face whose vertices are not the truth's.

    Args:
        face: vertices of the delivered face, world frame, mm.
        landmarks: of the delivered head, by name.
        truth: the true surface.
        true_landmarks: of the true head, by name; at least three of the seven are needed.
    """
    names = [name for name in SEVEN_POINTS if name in landmarks and name in true_landmarks]
    source = np.array([landmarks[name] for name in names])
    target = np.array([true_landmarks[name] for name in names])
    start = rigid_fit(source, target)
    some = face[np.random.default_rng(0).permutation(len(face))[:POINTS]]
    refined = _refine(start, some, source, target, truth)
    moved = _describe(refined @ start.inverse(), start.apply(face.mean(axis=0)))
    kept = moved.turn_deg <= MAX_REFINED_DEG and moved.shift_mm <= MAX_REFINED_MM
    return _describe(refined if kept else start, face.mean(axis=0))


def _refine(
    start: RigidTransform,
    points: Float[np.ndarray, "n 3"],
    source: Float[np.ndarray, "k 3"],
    target: Float[np.ndarray, "k 3"],
    truth: SurfaceIndex,
) -> RigidTransform:
    """Gauss-Newton on distances along the truth's normals, with the landmarks as weak observations beside them."""
    motion = start
    for _ in range(STEPS):
        moved, marks = motion.apply(points), motion.apply(source)
        hit = truth.closest(moved)
        near = hit.distances <= np.quantile(hit.distances, NEAREST_SHARE)
        across = ((hit.points - moved) * hit.normals).sum(axis=1)[near]
        middle = moved.mean(axis=0)
        rows = np.concatenate([np.cross(moved[near] - middle, hit.normals[near]), hit.normals[near]], axis=1)
        weight = SURFACE_WORTH / near.sum() / SURFACE_MM**2
        matrix, right = weight * rows.T @ rows, weight * rows.T @ across
        for axis in np.eye(3):
            row = np.concatenate([np.cross(marks - middle, axis), np.tile(axis, (len(marks), 1))], axis=1)
            matrix += row.T @ row / LANDMARK_MM**2
            right += row.T @ ((target - marks) @ axis) / LANDMARK_MM**2
        step = np.linalg.solve(matrix, right)
        turn = rotation_from_vector(step[:3])
        motion = RigidTransform(turn, middle + step[3:] - turn @ middle) @ motion
        if np.linalg.norm(step[:3]) < STILL_RAD and np.linalg.norm(step[3:]) < STILL_MM:
            break
    return motion


def _describe(truth_from_result: RigidTransform, middle: Float[np.ndarray, " 3"]) -> PoseError:
    return PoseError(
        truth_from_result,
        float(np.degrees(np.linalg.norm(vector_from_rotation(truth_from_result.rotation)))),
        float(np.linalg.norm(truth_from_result.apply(middle) - middle)),
    )

"""Aligns the head to the landmarks of the face in the photographs, instead of the clicked points of the paper's section
4.2.

The input is a face matched over the views, and the model's points that correspond to its landmarks. The output is
``world_from_head`` of the mean head, and the landmarks in the form that the contour solver uses. As for clicked points,
the covariance of the model's points describes how faces differ from the mean head; the pose explains all other
differences. Landmarks that contradict most others (an open jaw, a brow under a fringe) get less weight."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.contour_fit.landmark_term import observe_landmarks
from pipeline.contour_fit.problem import LandmarkObservations, blended_basis
from pipeline.faces.landmark_map import LandmarkMap
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.points import point_table
from pipeline.geometry.registration.rigid import block_diagonal, generalised_procrustes, procrustes
from pipeline.head_model.model import HeadModel
from rig.geometry import Similarity
from rig.rig import Rig

POINTS = 72  # spread over the face: errors of neighbours are correlated
ROUNDS = 3  # of reweighting
FORGIVEN_SIGMAS = 2.5  # a residual of that many deviations has twice its variance


@dataclass(frozen=True, slots=True, eq=False)
class FaceAlignment:
    """Holds the pose of the mean head on a face, and the landmarks to which it was fitted."""

    world_from_head: Similarity
    landmarks: LandmarkObservations


def align_to_face(model: HeadModel, face: MatchedFaces, places: LandmarkMap) -> FaceAlignment:
    """Aligns the mean head to the landmarks of a face. ``places`` are the model's points for the landmarks of the face.
    ``model`` must have the modes that the later fit uses."""
    which = spread_points(places)
    mean, basis = blended_basis(model, places.rows[which], places.weights[which])
    modes = basis.reshape(len(basis), -1).T.astype(float)
    idea, shape = places.covariance(which), modes @ modes.T  # of the network and of heads, head frame
    by_view = face.shared_mm[:, which].reshape(len(face.shared_mm), -1)
    target, point_covariances = face.points_world[which], face.covariances[which]
    source = mean + places.offset_mm[which]
    expected = np.diag(idea + shape).reshape(-1, 3).sum(axis=1) + point_covariances.trace(axis1=1, axis2=2)
    pose = procrustes(source, target, 1.0 / expected)
    noise = np.zeros_like(idea)
    for _ in range(ROUNDS):
        squares = ((target - pose.apply(source)) ** 2).sum(axis=1) / expected
        doubt = 1.0 + squares / FORGIVEN_SIGMAS**2
        noise = block_diagonal(
            (doubt - 1.0)[:, None, None] * (expected / 3.0)[:, None, None] * np.eye(3) + point_covariances
        )
        noise += by_view.T @ by_view
        pose = generalised_procrustes(source, target, idea + shape, noise, start=pose)
    turn = pose.scale * np.kron(np.eye(len(which)), pose.rotation)
    position = target - pose.scale * places.offset_mm[which] @ pose.rotation.T
    covariance = noise + turn @ idea @ turn.T
    landmarks = observe_landmarks(model, places.rows[which], places.weights[which], position, covariance)
    return FaceAlignment(pose, landmarks)


def spread_points(places: LandmarkMap) -> Int[np.ndarray, " n"]:
    """Returns the indices of at most ``POINTS`` landmarks that are spread evenly over the face and do not slide along
    it."""
    rest = np.flatnonzero(~places.slides)
    deviation = np.sqrt((places.deviation_mm**2).sum(axis=1))
    position = point_table().shape_mm
    chosen = [rest[int(deviation[rest].argmin())]]
    distance = np.full(len(rest), np.inf)
    while len(chosen) < min(POINTS, len(rest)):
        distance = np.minimum(distance, np.linalg.norm(position[rest] - position[chosen[-1]], axis=1))
        chosen.append(rest[int(distance.argmax())])
    return np.sort(np.array(chosen))


def frontmost_camera(facing_world: Float[np.ndarray, " 3"], middle_world: Float[np.ndarray, " 3"], rig: Rig) -> str:
    """Returns the name of the camera towards which a face is turned most directly."""
    towards = {camera.name: camera.centre_world - middle_world for camera in rig}
    return max(towards, key=lambda name: float(towards[name] @ facing_world / np.linalg.norm(towards[name])))

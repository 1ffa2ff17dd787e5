"""Searches the subject's face quickly after a shot, to report which pictures lack it and where it looks.

The search uses small pictures (``reduce_picture``) and ends after a few views without a face. A face that was found is
then searched in the other cameras that must show it.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.faces.eyes import closed_by_openings, eye_openings, eye_warnings
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.subject import SearchEffort, SubjectFaces
from rig.acquisition.face_sighting import FaceSighting
from rig.camera import Camera
from rig.geometry import Similarity
from rig.image import ImageRgb
from rig.rig import Rig

GLANCE_PX = 640  # longer side: a face of a third of it fills the networks' 192 px
SMALLEST_PX = 96  # shorter side: no face in a smaller picture is more than a guess
MUST_SEE = 0.7  # cosine: a camera within 45 degrees of where a face looks shows it, hair beside it or not
GLANCE = SearchEffort(max_fruitless=5, min_facing=MUST_SEE, rounds=3)
MIN_OFF_MIDDLE_DEG = 5.0  # of the cameras; less is the networks' own error
MIN_FAN = 0.3  # mean of the unit directions to the cameras: a fan of 180 degrees has 0.64, a full circle 0
MIN_WITNESSES = 2  # other cameras that show the face, before one is blamed that does not


def reduce_picture(image: ImageRgb, camera: Camera, longest_px: int) -> tuple[UInt8[np.ndarray, "_ _ 3"], Camera]:
    """Scales a picture and its camera down so that the picture's longer side is at most ``longest_px``."""
    factor = longest_px / max(image.shape[:2])
    if factor >= 1.0:
        return image, camera
    lens = camera.intrinsics.scaled(factor)
    small = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), replace(camera, intrinsics=lens)


def sight_face(subject: SubjectFaces, rig: Rig, *, front: str) -> FaceSighting:
    """Returns which cameras lack the subject's face, whether its eyes are closed, and its angle from the front camera.

    Args:
        subject: result of ``find_subject`` with the effort ``GLANCE`` (0.1 to 0.4 s for pictures of 640 px).
        rig: the cameras of these pictures.
        front: the camera that the subject is to look at.
    """
    face = subject.matched
    if face is None:
        return FaceSighting(len(subject.found), False, any(subject.found.values()), front)
    closed = eye_warnings(closed_by_openings(eye_openings(face, rig)))
    left_deg, up_deg = turned_deg(face.world_from_face, rig, front)
    return FaceSighting(len(subject.found), True, True, front, _missing(subject, face), left_deg, up_deg, tuple(closed))


def turned_deg(world_from_face: Similarity, rig: Rig, front: str) -> tuple[float, float] | tuple[None, None]:
    """Returns the angles (degrees, to the face's left and up) from a face to the front camera, if there is one."""
    if not has_front(rig):
        return None, None
    left, up = gaze_from(world_from_face, rig[front].axis_world if front in rig.names else -_fan(rig))
    middle_left, middle_up = gaze_from(world_from_face, -_fan(rig))
    return _turned(left, middle_left), _turned(up, middle_up)


def _turned(from_front_deg: float, from_middle_deg: float) -> float:
    """Returns the angle from the front camera, or 0 if the face looks between the front camera and the middle of all
    cameras. In a rig with rows of cameras, the front camera is above or below the middle of all cameras."""
    agreed = from_front_deg * from_middle_deg > 0.0 and abs(from_middle_deg) >= MIN_OFF_MIDDLE_DEG
    return from_front_deg if agreed else 0.0


def has_front(rig: Rig) -> bool:
    """Returns True if all cameras stand on one side of the subject, so that a front camera exists."""
    return float(np.linalg.norm(_fan(rig))) > MIN_FAN


def _fan(rig: Rig) -> Float[np.ndarray, " 3"]:
    """Returns the mean of the unit vectors from the subject to the cameras. The mean's length is 1 for cameras at the
    same place, 0 for a full ring."""
    directions = np.stack([camera.centre_world for camera in rig]) - rig.centre_world()
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions.mean(axis=0)


def gaze_from(world_from_face: Similarity, axis_world: Float[np.ndarray, " 3"]) -> tuple[float, float]:
    """Returns the angles (degrees) between a face and an axis of view: to the subject's left, and up."""
    towards = -axis_world / np.linalg.norm(axis_world)
    across, upwards, ahead = towards @ world_from_face.rotation
    return float(-np.degrees(np.arctan2(across, ahead))), float(-np.degrees(np.arcsin(np.clip(upwards, -1.0, 1.0))))


def _missing(subject: SubjectFaces, face: MatchedFaces) -> tuple[str, ...]:
    """Returns the cameras that must see the face, according to the other cameras, but have no detection of it."""
    if len(face.detections) < MIN_WITNESSES:
        return ()
    return tuple(name for name in subject.expected if name not in face.detections and not subject.found.get(name))


def file_pixels(pixels: Float[np.ndarray, "n 2"], read_by: Camera, recorded_by: Camera) -> Float[np.ndarray, "n 2"]:
    """Converts pixels of a reduced and undistorted picture to pixels of its file."""
    small, full = read_by.intrinsics, recorded_by.intrinsics
    scaled = (pixels + 0.5) * (full.width / small.width, full.height / small.height) - 0.5
    lens = recorded_by.recorded
    return scaled if lens is None else lens.distorted(scaled, full.matrix())

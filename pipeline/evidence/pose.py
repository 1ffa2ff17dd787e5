"""Checks the head's pose against the face in the photographs, and against the cost of other poses.

The module warns if the head misses the face in most views that show one. The module also warns if no face was found,
since the pose then depends on outlines only. The module also computes gaze and pupil distance from the irises.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.alignment.silhouette_search import fan_strength
from pipeline.evidence.measurements import Measurement
from pipeline.faces.detection import CERTAIN_SCORE, FaceDetection
from pipeline.faces.irises import Iris, UnseenEye
from pipeline.faces.landmark_map import LandmarkMap
from pipeline.faces.subject import SubjectFaces
from pipeline.warnings import ReportWarning
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.messages.message import compose, some_of
from rig.rig import Rig

PUPIL_DISTANCE = "pupil_distance"
ELSEWHERE = 0.12  # of the face's size in the picture, RMS over its points; of a right head 0.01 to 0.04
MIN_FACING = 0.5  # cosine: a camera that sees the head so far from the front must see the face, too
MIN_VIEWS = 2
CLEAR_FACING = 0.85  # cosine: a camera that sees all of the face
CLEAR_SCORE = 30.0  # of the landmark network: 35 and more of 30 heads; 27 with hair in a face, turned by 3 degrees then
ONE_SIDED = 0.95  # length of the cameras' mean direction: 0.98 for three within 12 degrees, 0.6 for the usual rig;
# in three-brows a pose that nods by 30 degrees beat all others by 75 %
RIVAL_MARGIN = 0.03  # of the cost of the outlines: a rival so near to the best is not beaten


@dataclass(frozen=True, slots=True, eq=False)
class PoseEvidence:
    """Holds the evidence for the pose. ``off``: for each camera, the RMS distance between the head's landmarks and the
    face's landmarks in the photograph, relative to the face's size. ``rival``: relative extra cost of the second best
    pose; None if no other pose was tried."""

    method: str
    off: Mapping[str, float]
    rival: float | None
    doubtful: bool

    @property
    def is_on_face(self) -> bool:
        """Returns True if a face was found and agrees with the head in every view that shows one."""
        return bool(self.off) and max(self.off.values()) <= ELSEWHERE


def judge_pose(
    head_world: Mesh,
    world_from_head: Similarity,
    rig: Rig,
    subject: SubjectFaces | None,
    places: LandmarkMap | None,
    *,
    method: str,
    rival: float | None,
) -> tuple[PoseEvidence, list[ReportWarning]]:
    """Compares the final head with the faces in the photographs. Returns the evidence and the warnings about the pose.

    ``head_world``: the head's full mesh (mm). ``world_from_head``: pose of the head. ``rig``: the cameras as
    calibrated. ``subject``: the faces; None if they were not searched. ``places``: positions of the landmarks on the
    head; None if there is no face. ``method``: method of the pose: features, landmarks or silhouettes. ``rival``: extra
    cost of the second best pose (``FoundPose.rival``).
    """
    warnings: list[ReportWarning] = []
    off: dict[str, float] = {}
    if subject is not None and places is not None:
        off = landmark_offsets(subject, places, head_world, world_from_head, rig)
        elsewhere = [name for name, share in off.items() if share > ELSEWHERE]
        if elsewhere and 2 * len(elsewhere) > len(off):
            worst = max(min(off[name], 10.0) for name in elsewhere)
            warnings.append(compose("face-elsewhere", cameras=some_of(elsewhere), sizes=worst))
        facing = cameras_in_front(world_from_head, rig)
        if not off and len(facing) >= MIN_VIEWS:
            warnings.append(compose("no-face", views=len(facing)))
    if subject is not None and subject.matched is not None:
        detections = subject.matched.detections
        if len(detections) < MIN_VIEWS:
            warnings.append(compose("pose-doubtful", finding=compose("pose-one-view", camera=next(iter(detections)))))
        clear = [detections[n].score for n in cameras_in_front(world_from_head, rig, CLEAR_FACING) if n in detections]
        if clear and max(clear) < CLEAR_SCORE:
            warnings.append(compose("pose-doubtful", finding=compose("pose-face-unclear")))
    if rival is not None and rival < RIVAL_MARGIN:
        warnings.append(compose("pose-doubtful", finding=compose("pose-rival", share=rival)))
    if method == "silhouettes" and fan_strength(rig) > ONE_SIDED:
        warnings.append(compose("pose-doubtful", finding=compose("pose-one-sided")))
    doubtful = bool(warnings)
    return PoseEvidence(method, off, rival, doubtful), warnings


def landmark_offsets(
    subject: SubjectFaces, places: LandmarkMap, head_world: Mesh, world_from_head: Similarity, rig: Rig
) -> dict[str, float]:
    """Returns, for each camera, the RMS distance between the head's landmarks and the face's landmarks in the
    photograph, relative to the face's size.

    In a view with several faces the nearest face is used; other faces may be posters or bystanders.
    """
    turned = world_from_head.scale * places.offset_mm @ world_from_head.rotation.T
    expected_world = (places.points(head_world.vertices) + turned)[~places.slides]
    offsets = {}
    for name, faces in _seen(subject).items():
        pixels = rig[name].project(expected_world)
        offsets[name] = min(_offset(pixels, face.landmarks_px[~places.slides], face.size_px) for face in faces)
    return offsets


def cameras_in_front(world_from_head: Similarity, rig: Rig, least: float = MIN_FACING) -> tuple[str, ...]:
    """Returns the names of the cameras that see the head from the front; ``least`` is the cosine of the angle."""
    facing, middle = world_from_head.rotation[:, 2], world_from_head.translation
    towards = {camera.name: camera.centre_world - middle for camera in rig}
    return tuple(name for name, way in towards.items() if way @ facing > least * np.linalg.norm(way))


def _seen(subject: SubjectFaces) -> dict[str, tuple[FaceDetection, ...]]:
    """Returns the subject's face in each camera. If the views agree on no face, the function returns all faces of each
    view, or none if too few views have a certain face."""
    if subject.matched is None:
        seen = {name: faces for name, faces in subject.found.items() if faces}
        doubtful = len(seen) < MIN_VIEWS and all(f.score < CERTAIN_SCORE for faces in seen.values() for f in faces)
        return {} if doubtful else seen
    return {name: (face,) for name, face in subject.matched.detections.items()}


def _offset(pixels: Float[np.ndarray, "n 2"], found: Float[np.ndarray, "n 2"], size_px: float) -> float:
    if not np.isfinite(pixels).all():
        return np.inf
    return float(np.sqrt(((pixels - found) ** 2).sum(axis=1).mean()) / size_px)


def pupils(eyes: Mapping[str, Iris | UnseenEye]) -> dict[str, Measurement]:
    """Returns the far pupil distance in a dictionary, which is empty if it was not measured."""
    found = pupil_distance(eyes)
    return {} if found is None else {PUPIL_DISTANCE: found}


def pupil_distance(eyes: Mapping[str, Iris | UnseenEye]) -> Measurement | None:
    """Returns the far pupil distance (mm); None unless both irises were found.

    The far pupil distance is measured while both eyes look at a point infinitely far ahead (ISO 13666). The far pupil
    distance equals the distance between the centres of the eyeballs, whatever the eyes looked at in the photographs."""
    right, left = eyes.get("right"), eyes.get("left")
    if not isinstance(right, Iris) or not isinstance(left, Iris):
        return None
    apart = left.eyeball - right.eyeball
    value = float(np.linalg.norm(apart))
    variance = sum(
        along @ iris.covariance @ along for iris in (right, left) for along in [apart / value @ iris.eyeball_jacobian]
    )
    return Measurement(value, float(np.sqrt(variance)))


def angles_deg(direction: Float[np.ndarray, " 3"]) -> tuple[float, float]:
    """Returns the azimuth (from z towards x) and elevation (towards y) of a unit vector, degrees. In the head frame
    positive azimuth is to the subject's left."""
    x, y, z = direction
    return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arcsin(np.clip(y, -1.0, 1.0))))

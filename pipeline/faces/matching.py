"""Finds the faces in several pictures that belong to the subject.

Every two detections that may show the same face are triangulated. The triangulated face must have the size (mm) and the
relief of a face (a poster is flat), and be turned towards its cameras. Further views are added if the points project
onto their detections. If the pictures show several faces, the subject's is the largest and most central one, since
bystanders stand behind.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import FaceDetection
from pipeline.faces.points import LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS, point_table
from pipeline.faces.triangulated_face import (
    SOME_POINTS,
    TriangulatedFace,
    point_noise_px,
    shared_modes,
    triangulate_face,
    unbiased_px,
    view_noise_px,
)
from rig.camera import Camera
from rig.geometry import Similarity
from rig.rig import Rig

EYE_DISTANCE_MM = (35.0, 90.0)  # between eyes' middles: infants 40, adults 50 to 75, and a rig's error of scale
RELIEF = (0.4, 1.8)  # depth of a face by the mean one's, at its size; a poster has none
MAX_VIEW_MISFIT = 3.0  # RMS of a view's residuals by their noise
MAX_SEEDS = 60  # pairs of detections that are tried
FEW_POINTS = [33, 133, 362, 263, 1, 168, 61, 291, 10, 152]  # eyes, nose, mouth, forehead and chin
MIN_SINE = 1e-3  # of the angle between two rays
MAX_GAP = 0.5  # between two rays of a point, by the points' mean distance from their middle
LOOSE = 1.5  # a first look at a size, from two views that may be wrong, is right to this factor
GROWING_ROUNDS = 5
MIN_FACING = -0.25  # cosine between where a face looks and a camera that may see it
DISSENTING_FACING = 0.5  # the same of a camera that must see it


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFaces:
    """Holds one person's face in several views, and its 468 points in the world frame (mm).

    The error of a point is the sum of three errors: one independent of other points (``covariances``); one common to
    all points in a view (``shared_mm``: each row times a standard normal number); and the network's bias towards an
    average face (``landmark_map.LandmarkMap`` of the model).
    """

    detections: Mapping[str, FaceDetection]  # by view
    outliers: Mapping[str, FaceDetection]  # of views where the face is seen, but the points are elsewhere
    pixels: Mapping[str, Float[np.ndarray, "468 2"]]  # the detections' points without the network's bias
    noise_px: Mapping[str, Float[np.ndarray, " 468"]]  # of a coordinate of each pixel, by its own
    view_noise_px: Mapping[str, float]  # of all pixels of a view together, along each axis
    points_world: Float[np.ndarray, "468 3"]
    covariances: Float[np.ndarray, "468 3 3"]  # mm^2
    shared_mm: Float[np.ndarray, "m 468 3"]  # two modes a view; more where one view alone shows the face
    residuals_px: Mapping[str, Float[np.ndarray, "468 2"]]  # ``pixels`` minus projected points
    world_from_face: Similarity  # of a mean adult's points (``points.PointTable``)
    relief: float  # 1 for a mean face, 0 for a poster

    @property
    def eye_distance_mm(self) -> float:
        """Returns the distance between the middles of the two eyes (mm)."""
        return _eye_distance_mm(self.points_world)

    @property
    def facing_world(self) -> Float[np.ndarray, " 3"]:
        """Returns the unit vector (world frame) in which the face is turned."""
        return self.world_from_face.rotation[:, 2]


def find_subject_face(
    candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig, eye_distance_mm: tuple[float, float] | None
) -> TriangulatedFace | None:
    """Finds the subject's face among all faces in the views (best first in each view), and triangulates every
    thirteenth of its points. Returns None if no two views show the same face. ``eye_distance_mm``: limits of the
    distance between the eyes; None if the rig's scale is not known."""
    faces = _consistent(candidates, rig, eye_distance_mm)
    return max(faces, key=lambda face: _prominence(face, rig), default=None)


def complete_match(
    face: TriangulatedFace, candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig
) -> MatchedFaces | None:
    """Triangulates all 468 points of the subject's face. Returns None if its views do not determine every point."""
    whole = triangulate_face(face.detections, rig)
    return whole and _matched(whole, rig, _outliers(face, candidates, rig))


def _consistent(
    candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig, eye_distance_mm: tuple[float, float] | None
) -> Iterator[TriangulatedFace]:
    """Returns the faces that two or more views show, each with all its views."""
    detections = [(name, face) for name, faces in candidates.items() for face in faces]
    pairs = [(a, b) for k, a in enumerate(detections) for b in detections[k + 1 :] if a[0] != b[0]]
    pairs.sort(key=lambda pair: -min(pair[0][1].score, pair[1][1].score))
    joined: list[set[int]] = []
    tried = 0
    for pair in pairs:
        ids = {id(face) for _, face in pair}
        if tried >= MAX_SEEDS or any(ids <= group for group in joined):
            continue
        if not _may_be_one(pair, rig, eye_distance_mm):
            continue
        tried += 1
        seed = triangulate_face(dict(pair), rig, SOME_POINTS)
        if seed is None or not _is_face(seed, rig, eye_distance_mm):
            continue
        grown = _grown(seed, candidates, rig)
        if (
            grown is not None
            and _is_face(grown, rig, eye_distance_mm)
            and _dissenting(grown, candidates, rig) <= len(grown.detections)
        ):
            joined.append({id(face) for face in grown.detections.values()})
            yield grown


def _may_be_one(
    pair: Sequence[tuple[str, FaceDetection]], rig: Rig, eye_distance_mm: tuple[float, float] | None
) -> bool:
    """Returns True if the viewing rays of two detections meet in points of a face's size. Each call takes 0.3 ms."""
    (centre, ray), (other, other_ray) = (
        (rig[name].centre_world, rig[name].rays_world(face.landmarks_px[FEW_POINTS])) for name, face in pair
    )
    across = np.cross(ray, other_ray)
    sine2 = (across**2).sum(axis=1)
    if not (sine2 > MIN_SINE**2).all():  # NaN where a pixel is outside its lens
        return False
    base = other - centre
    along = np.einsum("nk,nk->n", np.cross(base, other_ray), across) / sine2
    other_along = np.einsum("nk,nk->n", np.cross(base, ray), across) / sine2
    points, others = centre + along[:, None] * ray, other + other_along[:, None] * other_ray
    if min(along.min(), other_along.min()) <= 0.0:
        return False
    middles = (points + others) / 2
    size = float(np.linalg.norm(middles - middles.mean(axis=0), axis=1).mean())
    mean = point_table().shape_mm[FEW_POINTS]
    scale = size / float(np.linalg.norm(mean - mean.mean(axis=0), axis=1).mean())
    low, high = eye_distance_mm or (0.0, np.inf)
    gaps = np.linalg.norm(points - others, axis=1)
    in_limits = low / LOOSE < scale * mean_eye_distance_mm() < LOOSE * high
    return in_limits and float(np.median(gaps)) < MAX_GAP * size


def _grown(
    face: TriangulatedFace | None, candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig
) -> TriangulatedFace | None:
    """Adds to a face from two views all views in which its points project to a detection."""
    for _ in range(GROWING_ROUNDS):
        if face is None:
            return None
        nearest = {name: _nearest(face, faces, rig[name]) for name, faces in candidates.items() if faces}
        joining = {name: found for name, (found, misfit) in nearest.items() if misfit < MAX_VIEW_MISFIT}
        if len(joining) < 2 or joining == face.detections:
            return face
        face = triangulate_face(joining, rig, SOME_POINTS)
    return face


def _nearest(
    face: TriangulatedFace, detections: Sequence[FaceDetection], camera: Camera
) -> tuple[FaceDetection, float]:
    """Returns a view's detection nearest to the projected points of the face, and its misfit: the RMS of the residuals
    divided by their standard deviations. The misfit is infinite for a face behind the camera."""
    points, placed = face.points.positions_world, face.world_from_face
    pixels, slopes = camera.project_with_jacobian(points)
    if not np.isfinite(pixels).all():
        return detections[0], np.inf
    uncertain = np.einsum("nki,nij,nkj->nk", slopes, face.points.covariances, slopes)

    def misfit(detection: FaceDetection) -> float:
        noise = point_noise_px(detection.size_px, points, placed, camera, SOME_POINTS)
        view_noise = view_noise_px(detection.size_px, placed, camera)
        miss = unbiased_px(detection, placed, camera)[SOME_POINTS] - pixels
        return float(np.sqrt((miss**2 / (noise[:, None] ** 2 + view_noise**2 + uncertain)).mean()))

    misfits = [misfit(detection) for detection in detections]
    best = int(np.argmin(misfits))
    return detections[best], misfits[best]


def _is_face(face: TriangulatedFace, rig: Rig, eye_distance_mm: tuple[float, float] | None) -> bool:
    """Returns True if the points have the size and relief of a face, and face the cameras."""
    low, high = eye_distance_mm or (0.0, np.inf)
    scaled_mm = face.world_from_face.scale * mean_eye_distance_mm()
    middle, facing = face.world_from_face.translation, face.world_from_face.rotation[:, 2]
    towards = np.stack([rig[name].centre_world - middle for name in face.detections])
    cosines = towards @ facing / np.linalg.norm(towards, axis=1)
    return (
        low <= scaled_mm <= high
        and RELIEF[0] <= face.relief <= RELIEF[1]
        and bool((cosines > MIN_FACING).all())
        and max(face.misfits.values()) < MAX_VIEW_MISFIT
    )


def _dissenting(face: TriangulatedFace, candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig) -> int:
    """Counts the views that should show this face but show only other faces."""
    middle, facing = face.world_from_face.translation, face.world_from_face.rotation[:, 2]
    count = 0
    for name, faces in candidates.items():
        if not faces or name in face.detections:
            continue
        camera = rig[name]
        towards = camera.centre_world - middle
        pixel = camera.project(middle[None])[0]
        k = camera.intrinsics
        inside = bool(((pixel > 0.0) & (pixel < (k.width - 1, k.height - 1))).all())
        count += inside and bool(towards @ facing > DISSENTING_FACING * np.linalg.norm(towards))
    return count


def mean_eye_distance_mm() -> float:
    """Returns the distance between the middles of the eyes of the mean adult (mm)."""
    return _eye_distance_mm(point_table().shape_mm)


def _eye_distance_mm(points: Float[np.ndarray, "468 3"]) -> float:
    right, left = (points[list(pair)].mean(axis=0) for pair in (RIGHT_EYE_CORNERS, LEFT_EYE_CORNERS))
    return float(np.linalg.norm(left - right))


def _prominence(face: TriangulatedFace, rig: Rig) -> float:
    """Scores how large and how central a face is in its pictures."""

    def of_view(name: str, detection: FaceDetection) -> float:
        k = rig[name].intrinsics
        half = np.array([k.width, k.height]) / 2
        middle = (detection.box_px[:2] + detection.box_px[2:]) / 2
        off_middle = float(np.linalg.norm(middle - half + 0.5) / np.linalg.norm(half))
        return detection.size_px / max(k.width, k.height) * (1.0 - min(off_middle, 0.9))

    return sum(of_view(name, detection) for name, detection in face.detections.items())


def _outliers(
    face: TriangulatedFace, candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig
) -> dict[str, FaceDetection]:
    """Returns the detections in unmatched views that lie near the projected face but do not fit it."""
    found = {}
    for name, faces in candidates.items():
        if name not in face.detections and faces:
            nearest, _ = _nearest(face, faces, rig[name])
            middle = rig[name].project(face.points.positions_world).mean(axis=0)
            if np.linalg.norm(middle - nearest.landmarks_px.mean(axis=0)) < nearest.size_px / 2:
                found[name] = nearest
    return found


def _matched(face: TriangulatedFace, rig: Rig, outliers: Mapping[str, FaceDetection]) -> MatchedFaces:
    """Builds the ``MatchedFaces`` of a triangulated face."""
    names = list(face.detections)
    return MatchedFaces(
        detections=face.detections,
        outliers=outliers,
        pixels=dict(zip(names, face.pixels, strict=True)),
        noise_px=dict(zip(names, face.noise_px, strict=True)),
        view_noise_px=dict(zip(names, face.view_noise_px.tolist(), strict=True)),
        points_world=face.points.positions_world,
        covariances=face.points.covariances,
        shared_mm=shared_modes(face, rig),
        residuals_px=dict(zip(names, face.points.residuals_px, strict=True)),
        world_from_face=face.world_from_face,
        relief=face.relief,
    )

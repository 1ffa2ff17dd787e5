"""Which faces in several pictures are one subject's, and where its points lie in the world.

Enters: the faces found in each view. Leaves: ``MatchedFaces``, or None where no two views show one face. Two
detections that may be one face are triangulated; what comes out must be of a face's size (mm), have a face's relief
(a poster is flat), and look towards its cameras; other views join where their points project (epipolar consistency).
Of several faces that rig sees the one is taken that is large in the pictures and near to their middles: others stand
behind.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import FaceDetection
from pipeline.faces.points import LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS, point_table
from pipeline.multiview.triangulation import NoPoint, TriangulatedPoints, triangulate_many
from rig.camera import Camera
from rig.geometry import Similarity, rigid_fit
from rig.rig import Rig

EYE_DISTANCE_MM = (35.0, 90.0)  # between eyes' middles: infants 40, adults 50 to 75, and a rig's error of scale
RELIEF = (0.4, 1.8)  # depth of a face by the mean one's, at its size; a poster has none
NOISE_OF_SIZE = 0.012  # of the points of a face that looks at the camera, by the face's size
NOISE_GROWTH = 1.6  # its logarithm grows so by ``1 - cos`` of the angle from a point's normal to the camera
MAX_VIEW_MISFIT = 3.0  # RMS of a view's residuals by their noise
MAX_POINT_MISFIT = 3.0  # a residual by its noise, beyond which it counts as this much
MAX_SEEDS = 60  # pairs of detections that are tried
ALL_POINTS = slice(None)
SEED_POINTS = slice(0, None, 13)  # of the 468, for a first look at a pair
FEW_POINTS = [33, 133, 362, 263, 1, 168, 61, 291, 10, 152]  # eyes, nose, mouth, forehead and chin
MIN_SINE = 1e-3  # of the angle between two rays
MAX_GAP = 0.5  # between two rays of a point, by the points' mean distance from their middle
LOOSE = 1.5  # a first look at a size, from two views that may be wrong, is right to this factor
GROWING_ROUNDS = 5
REWEIGHTINGS = 2
MIN_FACING = -0.25  # cosine between where a face looks and a camera that may see it
DISSENTING_FACING = 0.5  # the same of a camera that must see it


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFaces:
    """One face in several views.

    ``noise_px`` is the standard deviation that was taken for a coordinate of each point, and what the covariances
    follow from; errors that all views share (of the network's idea of a face) are not in them but in a model's
    ``landmark_map.LandmarkMap``.
    """

    detections: Mapping[str, FaceDetection]  # by view
    outliers: Mapping[str, FaceDetection]  # of views where the face is seen, but the points are elsewhere
    points_world: Float[np.ndarray, "468 3"]
    covariances: Float[np.ndarray, "468 3 3"]  # mm^2
    residuals_px: Mapping[str, Float[np.ndarray, "468 2"]]  # found minus projected, of ``detections``
    noise_px: Mapping[str, Float[np.ndarray, " 468"]]
    world_from_face: Similarity  # of a mean adult's points (``points.PointTable``)
    relief: float  # 1 for a mean face, 0 for a poster

    @property
    def eye_distance_mm(self) -> float:
        """Between the middles of the eyes."""
        right, left = (self.points_world[list(pair)].mean(axis=0) for pair in (RIGHT_EYE_CORNERS, LEFT_EYE_CORNERS))
        return float(np.linalg.norm(left - right))

    @property
    def facing_world(self) -> Float[np.ndarray, " 3"]:
        """Unit vector along which the face looks."""
        return self.world_from_face.rotation[:, 2]


@dataclass(frozen=True, slots=True, eq=False)
class _Face:
    """Detections by view that may be one face, its points, and how it lies."""

    members: Mapping[str, FaceDetection]
    points: TriangulatedPoints
    noise_px: Float[np.ndarray, "v n"]
    world_from_face: Similarity
    relief: float
    misfits: Mapping[str, float]


def match_faces(
    candidates: Mapping[str, Sequence[FaceDetection]],
    rig: Rig,
    *,
    eye_distance_mm: tuple[float, float] | None = EYE_DISTANCE_MM,
) -> MatchedFaces | None:
    """Finds the face that the rig was set up for among all that its views show.

    Args:
        candidates: the faces found in each view, best first.
        rig: holds the views' cameras.
        eye_distance_mm: limits of a face's size; None where the rig's scale is not known.
    """
    faces = list(_consistent(candidates, rig, eye_distance_mm))
    if not faces:
        return None
    best = max(faces, key=lambda face: _prominence(face, rig))
    return _finished(best, candidates, rig)


def _consistent(
    candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig, eye_distance_mm: tuple[float, float] | None
) -> Iterator[_Face]:
    """Faces that two views or more agree on, each grown to all views that do."""
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
        seed = _face(dict(pair), rig, SEED_POINTS)
        if seed is None or not _is_face(seed, rig, eye_distance_mm):
            continue
        grown = _grown(dict(pair), candidates, rig)
        if (
            grown is not None
            and _is_face(grown, rig, eye_distance_mm)
            and _dissenting(grown, candidates, rig) <= len(grown.members)
        ):
            joined.append({id(face) for face in grown.members.values()})
            yield grown


def _may_be_one(
    pair: Sequence[tuple[str, FaceDetection]], rig: Rig, eye_distance_mm: tuple[float, float] | None
) -> bool:
    """Whether the rays of two detections meet, points of a face's size: a first look that takes 0.3 ms."""
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
    in_limits = low / LOOSE < scale * _mean_eye_distance() < LOOSE * high
    return in_limits and float(np.median(gaps)) < MAX_GAP * size


def _grown(
    members: Mapping[str, FaceDetection], candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig
) -> _Face | None:
    """The face of a pair, with the detections of all views in which its points project to what was found there."""
    face = _face(members, rig)
    for _ in range(GROWING_ROUNDS):
        if face is None:
            return None
        nearest = {name: _nearest(face, faces, rig[name]) for name, faces in candidates.items() if faces}
        joining = {name: found for name, (found, misfit) in nearest.items() if misfit < MAX_VIEW_MISFIT}
        if len(joining) < 2 or joining == face.members:
            return face
        face = _face(joining, rig)
    return face


def _face(members: Mapping[str, FaceDetection], rig: Rig, points: slice = ALL_POINTS) -> _Face | None:
    """Triangulates a face: with equal noise first, then, as it is known which points each view sees how steeply, again.
    None where the points are not determined."""
    cameras = [rig[name] for name in members]
    pixels = np.stack([face.landmarks_px[points] for face in members.values()])
    sizes = np.array([face.size_px for face in members.values()])
    noise = np.tile(NOISE_OF_SIZE * sizes[:, None], pixels.shape[1])
    table = point_table()
    try:
        found = triangulate_many(pixels, cameras, noise)
        for _ in range(REWEIGHTINGS):
            world_from_face, _ = _place(found.positions_world, table.shape_mm[points])
            normals = table.normals[points] @ world_from_face.rotation.T
            noise = np.stack(
                [_noise_px(size, found.positions_world, normals, c) for size, c in zip(sizes, cameras, strict=True)]
            )
            beyond = np.linalg.norm(found.residuals_px, axis=2) / (np.sqrt(2.0) * MAX_POINT_MISFIT * noise)
            noise = noise * np.maximum(beyond, 1.0)
            found = triangulate_many(pixels, cameras, noise)
    except NoPoint:
        return None
    world_from_face, relief = _place(found.positions_world, table.shape_mm[points])
    misfits = np.sqrt((found.residuals_px**2).mean(axis=2) / noise**2)
    by_view = {name: float(np.sqrt((misfit**2).mean())) for name, misfit in zip(members, misfits, strict=True)}
    return _Face(dict(members), found, noise, world_from_face, relief, by_view)


def _place(points_world: Float[np.ndarray, "n 3"], shape: Float[np.ndarray, "n 3"]) -> tuple[Similarity, float]:
    """Where a mean face lies that is most like the points, by its breadth and height, and their depth by its own."""
    mean, middle = shape.mean(axis=0), points_world.mean(axis=0)
    rotation = rigid_fit(shape, points_world).rotation
    within = (points_world - middle) @ rotation
    flat, shape = within[:, :2], shape - mean
    scale = float((flat * shape[:, :2]).sum() / (shape[:, :2] ** 2).sum())
    relief = float((within[:, 2] @ shape[:, 2]) / (shape[:, 2] @ shape[:, 2]) / scale) if scale > 0.0 else 0.0
    return Similarity(scale, rotation, middle - scale * rotation @ mean), relief


def _noise_px(
    size_px: float, points_world: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Camera
) -> Float[np.ndarray, " n"]:
    """Standard deviation of a coordinate of each point in a view."""
    towards = camera.centre_world - points_world
    cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return NOISE_OF_SIZE * size_px * np.exp(NOISE_GROWTH * (1.0 - cosine))


def _is_face(face: _Face, rig: Rig, eye_distance_mm: tuple[float, float] | None) -> bool:
    """Whether the points are a face's: of its size and relief, and turned towards its cameras."""
    low, high = eye_distance_mm or (0.0, np.inf)
    scaled_mm = face.world_from_face.scale * _mean_eye_distance()
    middle, facing = face.world_from_face.translation, face.world_from_face.rotation[:, 2]
    towards = np.stack([rig[name].centre_world - middle for name in face.members])
    cosines = towards @ facing / np.linalg.norm(towards, axis=1)
    return (
        low <= scaled_mm <= high
        and RELIEF[0] <= face.relief <= RELIEF[1]
        and bool((cosines > MIN_FACING).all())
        and max(face.misfits.values()) < MAX_VIEW_MISFIT
    )


def _dissenting(face: _Face, candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig) -> int:
    """How many views that should show the face show faces, but not this one."""
    middle, facing = face.world_from_face.translation, face.world_from_face.rotation[:, 2]
    count = 0
    for name, faces in candidates.items():
        if not faces or name in face.members:
            continue
        camera = rig[name]
        towards = camera.centre_world - middle
        pixel = camera.project(middle[None])[0]
        k = camera.intrinsics
        inside = bool(((pixel > 0.0) & (pixel < (k.width - 1, k.height - 1))).all())
        count += inside and bool(towards @ facing > DISSENTING_FACING * np.linalg.norm(towards))
    return count


def _mean_eye_distance() -> float:
    """Of the mean adult, mm."""
    shape = point_table().shape_mm
    right, left = (shape[list(pair)].mean(axis=0) for pair in (RIGHT_EYE_CORNERS, LEFT_EYE_CORNERS))
    return float(np.linalg.norm(left - right))


def _nearest(face: _Face, detections: Sequence[FaceDetection], camera: Camera) -> tuple[FaceDetection, float]:
    """Of a view's detections the one nearest to where the face's points project, and its misfit: the RMS of residuals
    by what the points' noise there and their uncertainty lead to expect; infinite behind the camera."""
    pixels, slopes = camera.project_with_jacobian(face.points.positions_world)
    if not np.isfinite(pixels).all():
        return detections[0], np.inf
    uncertain = np.einsum("nki,nij,nkj->nk", slopes, face.points.covariances, slopes)
    normals = point_table().normals @ face.world_from_face.rotation.T

    def misfit(detection: FaceDetection) -> float:
        noise = _noise_px(detection.size_px, face.points.positions_world, normals, camera)
        return float(np.sqrt(((detection.landmarks_px - pixels) ** 2 / (noise[:, None] ** 2 + uncertain)).mean()))

    misfits = [misfit(detection) for detection in detections]
    best = int(np.argmin(misfits))
    return detections[best], misfits[best]


def _prominence(face: _Face, rig: Rig) -> float:
    """Over the views, how large the face is in the picture and how near to its middle."""

    def of_view(name: str, detection: FaceDetection) -> float:
        k = rig[name].intrinsics
        half = np.array([k.width, k.height]) / 2
        middle = (detection.box_px[:2] + detection.box_px[2:]) / 2
        off_middle = float(np.linalg.norm(middle - half + 0.5) / np.linalg.norm(half))
        return detection.size_px / max(k.width, k.height) * (1.0 - min(off_middle, 0.9))

    return sum(of_view(name, detection) for name, detection in face.members.items())


def _finished(face: _Face, candidates: Mapping[str, Sequence[FaceDetection]], rig: Rig) -> MatchedFaces:
    """The face as it is handed on."""
    outliers = {}
    for name, faces in candidates.items():
        if name not in face.members and faces:
            found, _ = _nearest(face, faces, rig[name])
            pixels = rig[name].project(face.points.positions_world)
            if np.linalg.norm(pixels.mean(axis=0) - found.landmarks_px.mean(axis=0)) < found.size_px / 2:
                outliers[name] = found
    names = list(face.members)
    return MatchedFaces(
        face.members,
        outliers,
        face.points.positions_world,
        face.points.covariances,
        dict(zip(names, face.points.residuals_px, strict=True)),
        dict(zip(names, face.noise_px, strict=True)),
        face.world_from_face,
        face.relief,
    )

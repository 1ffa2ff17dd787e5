"""Computes the scale of a scene, whose unit of length is arbitrary, from a known length or from the mean size of heads.

The file ``scale.json`` states a known length. Without a known length, the face in the photographs is assumed to have a
mean adult's size. If no two views show a face, the scene points near the cameras' optical axes are assumed to be a head
of the head model's mean size. Hair, neck and furniture make such an assumed scale less accurate. Reports mark assumed
scales.

A known length also converts cameras from another program, whose unit is unknown, to millimetres. If the cameras agree
with the length within its uncertainty, they are not changed, because they may come from a more precise board.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from calibration.scene.photographs import Photographs
from calibration.scene.structure import Structure
from pipeline.faces.networks import load_networks
from pipeline.faces.subject import SearchEffort, find_subject
from pipeline.multiview.triangulation import NoPoint, TriangulatedPoint, triangulate
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.scale_json import CameraDistance, KnownLength, PointDistance, TagSize, dictionaries
from rig.formats.pictures.images import decode_image_file
from rig.formats.pictures.work_size import WORK_PIXELS, work_features, work_rig, work_share
from rig.messages.message import Message, compose
from rig.rig import Rig

PICKED_PX = 1.0  # of a point picked by hand, an axis
TAG_PX = 0.3  # of a tag's corner, refined below a pixel
HEAD_SHARE = 0.2  # standard deviation of what the size of a head tells
FACE_SHARE = 0.06  # of a face's: adults' differ by .05 (ANSUR II: breadth and height), the network's points by .03
ASSUMED = ("face-size", "head-size")
HALF_PIXEL = 0.5
AGREES_SHARES = 3.0  # standard deviations of the known length
AGREES_LEAST = 0.002  # and at least this share: half a millimetre of a head


"""AprilTag's edge lines count from a pixel's corner. They leave sides unbiased; OpenCV's own corners, refined below a
pixel, lie 0.15 px inside each way: 1 % of a tag of 35 px."""
TAG_MISS_PX = 3.0  # beyond it a corner of another tag was taken for it, or the tag was moved
POINTS_LEAST = 30


@dataclass(frozen=True, slots=True)
class Scale:
    """Holds the factor that converts a structure's lengths to millimetres.

    Attributes:
        factor: millimetres in its unit of length.
        share: relative standard deviation of ``factor``.
        source: points, tag, cameras, face-size or head-size.
        provenance: where the scale comes from, as a sentence.
    """

    factor: float
    share: float
    source: str
    provenance: Message

    @property
    def assumed(self) -> bool:
        """Returns whether the scale is assumed because no length is known."""
        return self.source in ASSUMED


def find_scale(
    structure: Structure, known: KnownLength | None, photographs: Photographs, head: Float[np.ndarray, "v 3"]
) -> Scale:
    """Computes the scale of a structure from the length ``known``. If ``known`` is None, uses the mean size of a face,
    or of a head with the vertices ``head`` (mm). Raises InputError if the photographs do not show the known length."""
    if isinstance(known, PointDistance):
        return scale_from_points(structure.rig, known)
    if isinstance(known, CameraDistance):
        return scale_from_cameras(structure.rig, known)
    if isinstance(known, TagSize):
        return scale_from_tags(structure.rig, known, find_tags(photographs, known))
    return scale_from_face(structure.rig, photographs) or scale_from_head(structure, head)


def scale_from_cameras(rig: Rig, known: CameraDistance) -> Scale:
    """Computes the scale from the known distance between two cameras' centres. A user can locate the centre inside a
    lens only to a few millimetres. Raises InputError if the rig lacks one of the two cameras."""
    lost = [name for name in known.cameras if name not in rig]
    if lost:
        raise InputError("scale.json", [compose("scale-camera-lost", camera=name) for name in lost])
    one, other = (rig[name].centre_world for name in known.cameras)
    factor = known.distance_mm / float(np.linalg.norm(one - other))
    provenance = compose(
        "scale-by-cameras", distance_mm=known.distance_mm, first=known.cameras[0], second=known.cameras[1]
    )
    return Scale(factor, 2.0 / known.distance_mm, "cameras", provenance)


def scale_from_points(rig: Rig, known: PointDistance) -> Scale:
    """Computes the scale from the known distance between two points that a user picked in two or more views. Raises
    InputError if a point cannot be triangulated."""
    ends, faults = [], []
    for name, views in (("first", known.first), ("second", known.second)):
        joined = {camera: pixel for camera, pixel in views.items() if camera in rig}
        try:
            ends.append(triangulate(joined, rig, noise_px=PICKED_PX))
        except NoPoint as error:
            lost = sorted(set(views) - set(joined))
            faults.append(
                compose("scale-points-lost", which=name, reason=error.message, lost=lost)
                if lost
                else compose("scale-points-unusable", which=name, reason=error.message)
            )
    if faults:
        raise InputError("scale.json", faults)
    return _between(ends, known.distance_mm, "points", compose("scale-by-points", distance_mm=known.distance_mm))


def _between(ends: list[TriangulatedPoint], length_mm: float, source: str, provenance: Message) -> Scale:
    across = ends[1].position_world - ends[0].position_world
    length = float(np.linalg.norm(across))
    along = across / length
    share = float(np.sqrt(along @ (ends[0].covariance + ends[1].covariance) @ along)) / length
    return Scale(length_mm / length, share, source, provenance)


Tags = Mapping[tuple[str, int], Mapping[str, Float[np.ndarray, "4 2"]]]


def find_tags(photographs: Photographs, known: TagSize) -> Tags:
    """Finds square tags in all photographs. Returns their corners (px) by shot and tag number, then by camera."""
    files = ((camera, shot, path) for camera, shots in photographs.files.items() for shot, path in shots.items())
    decoded = ((camera, shot, decode_image_file(path, path.name, "grey")[0]) for camera, shot, path in files)
    return _tags_of(((camera, shot, grey) for camera, shot, grey in decoded if grey is not None), known)


def _tags_of(pictures: Iterable[tuple[str, str, UInt8[np.ndarray, "h w"]]], known: TagSize) -> Tags:
    """Finds tags in grey pictures, each listed after its camera and shot."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    dictionary = cv2.aruco.getPredefinedDictionary(dictionaries()[known.dictionary])
    detector, tags = cv2.aruco.ArucoDetector(dictionary, parameters), dict[tuple[str, int], dict[str, np.ndarray]]()
    for camera, shot, grey in pictures:
        for number, corners in _tags_in(grey, detector).items():
            tags.setdefault((shot, number), {})[camera] = corners
    return tags


def _tags_in(grey: UInt8[np.ndarray, "h w"], detector: cv2.aruco.ArucoDetector) -> dict[int, Float[np.ndarray, "4 2"]]:
    """Returns the corners (px) of each tag by its number, without numbers that occur twice."""
    corners, ids, _ = detector.detectMarkers(grey)
    numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
    return {
        number: corner.reshape(4, 2) - HALF_PIXEL
        for number, corner in zip(numbers, corners, strict=True)
        if numbers.count(number) == 1
    }


def scale_from_tags(rig: Rig, known: TagSize, tags: Tags) -> Scale:
    """Computes the scale from the known side of tags, as the median over all tags that two or more views show. Raises
    InputError if no tag is in two views."""
    markers = []
    for number, views in tags.items():
        joined = {camera: corners for camera, corners in views.items() if camera in rig}
        try:
            corners = [triangulate({c: px[k] for c, px in joined.items()}, rig, noise_px=TAG_PX) for k in range(4)]
        except NoPoint:
            continue
        worst = max(float(np.abs(miss).max()) for corner in corners for miss in corner.residuals_px.values())
        if worst < TAG_MISS_PX:
            sides = [
                _between([corners[k], corners[(k + 1) % 4]], known.size_mm, "tag", compose("scale-unsaid"))
                for k in range(4)
            ]
            markers.append(
                (np.mean([side.factor for side in sides]), np.mean([side.share for side in sides]), number[1])
            )
    if not markers:
        cameras = sorted({camera for views in tags.values() for camera in views})
        provenance = compose("scale-tag-seen", cameras=cameras) if cameras else compose("scale-tag-unseen")
        raise InputError("scale.json", [provenance])
    factor = float(np.median([factor for factor, _, _ in markers]))
    numbers = sorted({number for *_, number in markers})
    provenance = compose("scale-by-tags", count=len(numbers), size_mm=known.size_mm, numbers=numbers)
    return Scale(factor, float(np.median([share for _, share, _ in markers])), "tag", provenance)


def scale_from_face(rig: Rig, photographs: Photographs) -> Scale | None:
    """Computes the scale at which the face in the first shot has a mean adult's size. Returns None if fewer than two
    photographs agree on the face."""
    images, small = {}, work_rig(rig, WORK_PIXELS)
    for camera in rig:
        path = next(iter(photographs.files[camera.name].values()))
        share = work_share(camera.intrinsics, WORK_PIXELS)
        pixels, _, _ = decode_image_file(path, path.name, "colour", share=share)
        assert pixels is not None  # matching has read it
        images[camera.name] = pixels
    effort = SearchEffort(with_eyes=False)
    face = find_subject(images, small, load_networks(), eye_distance_mm=None, effort=effort).matched
    if face is None or len(face.detections) < 2:
        return None
    return Scale(1.0 / face.world_from_face.scale, FACE_SHARE, ASSUMED[0], compose("scale-by-face"))


def scale_from_head(structure: Structure, head: Float[np.ndarray, "v 3"]) -> Scale:
    """Computes the scale at which the scene points around the subject have the same median distance from their middle
    as the vertices ``head`` (mm) of a mean head."""
    points = _looked_at(structure)
    ratio = _median_radius(head) / _median_radius(points)
    provenance = compose("scale-by-head")
    return Scale(ratio, HEAD_SHARE, ASSUMED[1], provenance)


def _looked_at(structure: Structure) -> Float[np.ndarray, "p 3"]:
    """Returns the points in a sphere around the point nearest to all optical axes that most cameras see whole."""
    centre, radii = structure.rig.centre_world(), []
    for camera in structure.rig:
        k = camera.intrinsics
        half = min(k.width / k.fx, k.height / k.fy) / 2
        radii.append(float(np.linalg.norm(camera.centre_world - centre)) * np.sin(np.arctan(half)))
    away = np.linalg.norm(structure.points - centre, axis=1)
    radius = float(np.quantile(radii, 0.2))
    while (near := away < radius).sum() < min(POINTS_LEAST, len(away)):
        radius *= 1.2
    return structure.points[near]


def _median_radius(points: Float[np.ndarray, "p 3"]) -> float:
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def scale_by_length(capture: Capture, rig: Rig, full: Rig, known: KnownLength) -> tuple[Rig, list[Message]]:
    """Scales a rig so that a known length is correct (mm). Returns the scaled rig and a message about the change. If
    the rig agrees with the length within its uncertainty, returns the unchanged rig and no message.

    Args:
        capture: pictures as ``rig`` took them.
        rig: the cameras, perhaps of pictures that were read at a smaller size.
        full: the cameras of the original files, in whose pixels points were picked.
        known: the length.

    Raises InputError if the pictures do not show the length.
    """
    scale = _scale(capture, rig, full, known)
    if abs(np.log(scale.factor)) <= max(AGREES_LEAST, AGREES_SHARES * scale.share):
        return replace(rig, scale_sigma=min(rig.scale_sigma, scale.share)), []
    return replace(times(rig, scale.factor), scale_sigma=scale.share), [
        compose("cameras-scaled", factor=scale.factor, scale=scale.provenance)
    ]


def times(rig: Rig, factor: float) -> Rig:
    """Multiplies all lengths of the rig by ``factor``, and scales its covariances accordingly."""
    grows = np.diag([1.0, 1.0, 1.0, factor, factor, factor])
    return replace(
        rig,
        cameras=tuple(
            replace(
                camera,
                camera_from_world=replace(
                    camera.camera_from_world, translation=camera.camera_from_world.translation * factor
                ),
                covariance=None if camera.covariance is None else grows @ camera.covariance @ grows,
            )
            for camera in rig
        ),
    )


def _scale(capture: Capture, rig: Rig, full: Rig, known: KnownLength) -> Scale:
    if isinstance(known, CameraDistance):
        return scale_from_cameras(rig, known)
    if isinstance(known, PointDistance):
        ends = {"first": known.first, "second": known.second}
        pixels = work_features(
            {end: {name: _undistorted(full, name, at) for name, at in views.items()} for end, views in ends.items()},
            full,
            rig,
        )
        return scale_from_points(rig, PointDistance(pixels["first"], pixels["second"], known.distance_mm))
    greys = {name: np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for name, image in capture.images.items()}
    return scale_from_tags(rig, known, _tags_of(((name, "", grey) for name, grey in greys.items()), known))


def _undistorted(full: Rig, name: str, pixel: np.ndarray) -> np.ndarray:
    """Converts a pixel of the original file to the undistorted picture that the program works on."""
    lens = full[name].recorded
    return pixel if lens is None else lens.undistorted(pixel[None], full[name].intrinsics.matrix())[0]

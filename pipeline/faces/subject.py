"""Finds the subject's face in all views of a rig: searches a few views, then looks in the others where the face must
be.

Enters: pictures and rig. Leaves: ``SubjectFaces``. To search a picture takes 0.06 s, to look at a known place 0.01 s.
Views far apart are searched until two or more agree on a face; it is then projected into all others.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.faces.crops import Pyramid, make_pyramid
from pipeline.faces.detection import (
    CERTAIN_SCORE,
    MIN_SCORE,
    FaceDetection,
    crop_around,
    find_face_at,
    find_large_faces,
    find_small_faces,
)
from pipeline.faces.eyes import find_eyes
from pipeline.faces.matching import EYE_DISTANCE_MM, MatchedFaces, complete_match, find_subject_face
from pipeline.faces.networks import FaceNetworks
from pipeline.faces.points import direction_from_face, point_table
from pipeline.faces.single_view import match_alone
from pipeline.faces.triangulated_face import TriangulatedFace
from pipeline.multiview.spread_views import spread_views
from rig.capture import ImageRgb
from rig.geometry import Similarity
from rig.rig import Rig

SMALL_FACE_VIEWS = 3  # in which small faces are searched where no view has a large one
APART_DEG = 35.0  # between views: a face that one sees well is seen by the other, and their rays meet steeply
LOOKING_ROUNDS = 1  # of a crop at least, from a projected face
CONFIRMING_VIEWS = 3  # that must show one face before no more are searched
MIN_FACING = -0.1  # cosine between where a face looks and a camera in which it is looked for: to a profile
MIN_EYES_FACING = 0.5  # the same for a camera that sees both eyes
MIN_INSIDE = 0.6  # share of a face's points within a picture


@dataclass(frozen=True, slots=True)
class SearchEffort:
    """Holds how thoroughly the subject's face is searched.

    Attributes:
        max_fruitless: the search ends after this many views without a face; None searches all views, and then for small
            faces.
        min_facing: a known face is looked for in cameras to which it turns; the smallest cosine between both
            directions.
        rounds: how often that is repeated, as more views have the face.
        with_eyes: whether irises and lids are found, too.
    """

    max_fruitless: int | None = None
    min_facing: float = MIN_FACING
    rounds: int = 1
    with_eyes: bool = True


THOROUGH = SearchEffort()


@dataclass(frozen=True, slots=True, eq=False)
class SubjectFaces:
    """Holds the faces found in each view that was searched, the best first, and which of them are the subject's. If a
    single view shows a face, and without doubt, its points are a mean adult's (``single_view``)."""

    found: Mapping[str, tuple[FaceDetection, ...]]
    matched: MatchedFaces | None  # None where views that show faces do not agree on one
    expected: tuple[str, ...]  # views towards which the matched face looks, and whose pictures hold it


def find_subject(
    images: Mapping[str, ImageRgb],
    rig: Rig,
    networks: FaceNetworks,
    *,
    eye_distance_mm: tuple[float, float] | None = EYE_DISTANCE_MM,
    effort: SearchEffort = THOROUGH,
    report: Callable[[float], None] = lambda _: None,
) -> SubjectFaces:
    """Finds the subject's face in the views of one shot.

    Args:
        images: by camera; those of cameras that the rig lacks are ignored.
        rig: the cameras.
        networks: the result of ``load_networks``.
        eye_distance_mm: limits of a face's size; None if the rig's scale is not known.
        effort: how thorough the search is.
        report: called with the share that is done.
    """
    views = rig.subset(name for name in rig.names if name in images)
    if not len(views):
        return SubjectFaces({}, None, ())
    scene = _Scene(views, {name: make_pyramid(images[name]) for name in views.names}, networks, eye_distance_mm, effort)
    in_order = spread_views(views, len(views))
    found, face = _search(scene, in_order, find_large_faces, report)
    if not any(found.values()) and effort.max_fruitless is None:
        found, face = _search(scene, in_order[:SMALL_FACE_VIEWS], find_small_faces, report)
    report(1.0)
    matched = complete_match(face, found, views) if face is not None else _matched_alone(found, views)
    if matched is None:
        return SubjectFaces(found, None, ())
    placed = matched.world_from_face
    with_eyes = {
        name: find_eyes(scene.pyramids[name], seen, networks)
        if effort.with_eyes and direction_from_face(placed, rig[name])[2] > MIN_EYES_FACING
        else seen
        for name, seen in matched.detections.items()
    }
    return SubjectFaces(
        found, replace(matched, detections=with_eyes), tuple(_expected(placed, views, effort.min_facing))
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What a search goes through."""

    rig: Rig
    pyramids: Mapping[str, Pyramid]
    networks: FaceNetworks
    eye_distance_mm: tuple[float, float] | None
    effort: SearchEffort

    def match(self, found: Mapping[str, tuple[FaceDetection, ...]]) -> TriangulatedFace | None:
        """Finds the subject among the faces of all views."""
        return find_subject_face(found, self.rig, self.eye_distance_mm)


def _search(
    scene: _Scene,
    in_order: Sequence[str],
    find: Callable[[Pyramid, FaceNetworks], tuple[FaceDetection, ...]],
    report: Callable[[float], None],
) -> tuple[dict[str, tuple[FaceDetection, ...]], TriangulatedFace | None]:
    """Searches view after view until one face is confirmed: the faces of each that was searched or looked at, and the
    subject's."""
    found: dict[str, tuple[FaceDetection, ...]] = {}
    face = None
    while left := [name for name in in_order if name not in found]:
        report(len(found) / len(in_order))
        name = _next_view(left, found, scene.rig)
        found[name] = find(scene.pyramids[name], scene.networks)
        if found[name] and (face := scene.match(found)) is not None:
            for _ in range(scene.effort.rounds):
                added = {} if face is None else _search_missing(scene, face, found)
                if not added:
                    break
                found |= added
                face = scene.match(found)
            if face is not None and len(face.detections) >= CONFIRMING_VIEWS:
                break
        if sum(not faces for faces in found.values()) == scene.effort.max_fruitless:
            break
    return found, face


def _next_view(left: Sequence[str], found: Mapping[str, tuple[FaceDetection, ...]], rig: Rig) -> str:
    """The view to search next: the first that is left until a face is found, then the one that looks from about
    ``APART_DEG`` beside the view that shows the best one."""
    seen = [name for name in found if found[name]]
    if not seen:
        return left[0]
    best = max(seen, key=lambda name: found[name][0].score)
    middle = rig.centre_world()

    def apart_deg(name: str) -> float:
        towards, other = rig[name].centre_world - middle, rig[best].centre_world - middle
        return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(towards, other)), towards @ other)))

    return min(left, key=lambda name: abs(apart_deg(name) - APART_DEG))


def _matched_alone(found: Mapping[str, tuple[FaceDetection, ...]], rig: Rig) -> MatchedFaces | None:
    """The face that is beyond doubt and the only one that any view shows."""
    seen = [(name, faces) for name, faces in found.items() if faces]
    if len(seen) != 1 or len(seen[0][1]) != 1 or seen[0][1][0].score < CERTAIN_SCORE:
        return None
    name, (face,) = seen[0]
    return match_alone(name, face, rig[name])


def _search_missing(
    scene: _Scene, face: TriangulatedFace, found: Mapping[str, tuple[FaceDetection, ...]]
) -> dict[str, tuple[FaceDetection, ...]]:
    """Looks for a face in the views in which it must be and was not found; what was found there comes after it."""
    added = {}
    points = face.world_from_face.apply(point_table().shape_mm)
    for name in _expected(face.world_from_face, scene.rig, scene.effort.min_facing):
        if name in face.detections:
            continue
        crop = crop_around(scene.rig[name].project(points))
        seen = find_face_at(scene.pyramids[name], crop, scene.networks, min_rounds=LOOKING_ROUNDS)
        if seen.score >= MIN_SCORE:
            added[name] = (seen, *found.get(name, ()))
    return added


def _expected(world_from_face: Similarity, rig: Rig, min_facing: float) -> Iterator[str]:
    """The views towards which a face looks and whose pictures hold it."""
    points = world_from_face.apply(point_table().shape_mm)
    for camera in rig:
        pixels = camera.project(points)
        size = (camera.intrinsics.width, camera.intrinsics.height)
        inside = ((pixels > -0.5) & (pixels < np.array(size) - 0.5)).all(axis=1)  # False where a pixel is NaN
        facing = direction_from_face(world_from_face, camera)[2]
        if facing >= min_facing and inside.mean() > MIN_INSIDE and np.isfinite(pixels).all():
            yield camera.name

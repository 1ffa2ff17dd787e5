"""The subject's face in all views of a rig: searched for in a few, then looked for where it must be.

Enters: pictures and rig. Leaves: ``SubjectFaces``. Searching a picture takes 0.06 s, looking at a known place 0.01 s.
Views far apart are searched until two or more agree on a face; it is then projected to all others.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.faces.crops import Pyramid, make_pyramid
from pipeline.faces.detection import (
    MIN_SCORE,
    FaceDetection,
    crop_around,
    find_face_at,
    find_large_faces,
    find_small_faces,
)
from pipeline.faces.eyes import find_eyes
from pipeline.faces.matching import EYE_DISTANCE_MM, MatchedFaces, match_faces
from pipeline.faces.networks import FaceNetworks
from pipeline.multiview.spread_views import spread_views
from rig.capture import ImageRgb
from rig.rig import Rig

SMALL_FACE_VIEWS = 3  # in which small faces are searched where no view has a large one
CONFIRMING_VIEWS = 3  # that must show one face before no more are searched
PREDICTED_ROUNDS = 2  # of the crop, from a projected face
MIN_FACING = -0.1  # cosine between where a face looks and a camera in which it is looked for: to a profile
MIN_EYES_FACING = 0.5  # the same for a camera that sees both eyes
MIN_INSIDE = 0.6  # share of a face's points within a picture


@dataclass(frozen=True, slots=True, eq=False)
class SubjectFaces:
    """What was found in each view that was searched or looked at, best first, and the subject among it."""

    found: Mapping[str, tuple[FaceDetection, ...]]
    matched: MatchedFaces | None  # None where no two views agree
    expected: tuple[str, ...]  # views towards which the face looks, and whose picture holds it


def find_subject(
    images: Mapping[str, ImageRgb],
    rig: Rig,
    networks: FaceNetworks,
    *,
    eye_distance_mm: tuple[float, float] | None = EYE_DISTANCE_MM,
    report: Callable[[float], None] = lambda _: None,
) -> SubjectFaces:
    """Finds the subject's face in the views of one shot.

    Args:
        images: by camera; those of cameras that the rig lacks are passed over.
        rig: the cameras.
        networks: as ``load_networks`` loads them.
        eye_distance_mm: limits of a face's size; None where the rig's scale is not known.
        report: is told the share that is done.
    """
    views = rig.subset(name for name in rig.names if name in images)
    scene = _Scene(views, {name: make_pyramid(images[name]) for name in views.names}, networks, eye_distance_mm)
    in_order = spread_views(views, len(views))
    found, matched = _search(scene, in_order, find_large_faces, report)
    if not any(found.values()):
        found, matched = _search(scene, in_order[:SMALL_FACE_VIEWS], find_small_faces, report)
    report(1.0)
    if matched is None:
        return SubjectFaces(found, None, ())
    looking = _towards(matched, views)
    with_eyes = {
        name: find_eyes(scene.pyramids[name], face, networks) if looking[name] > MIN_EYES_FACING else face
        for name, face in matched.detections.items()
    }
    return SubjectFaces(found, replace(matched, detections=with_eyes), tuple(_expected(matched, views)))


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What a search goes through."""

    rig: Rig
    pyramids: Mapping[str, Pyramid]
    networks: FaceNetworks
    eye_distance_mm: tuple[float, float] | None

    def match(self, found: Mapping[str, tuple[FaceDetection, ...]]) -> MatchedFaces | None:
        """The subject among the faces of all views."""
        return match_faces(found, self.rig, eye_distance_mm=self.eye_distance_mm)


def _search(
    scene: _Scene,
    in_order: Sequence[str],
    find: Callable[[Pyramid, FaceNetworks], tuple[FaceDetection, ...]],
    report: Callable[[float], None],
) -> tuple[dict[str, tuple[FaceDetection, ...]], MatchedFaces | None]:
    """Searches view after view until one face is confirmed: the faces of each that was searched or looked at, and the
    subject's."""
    found: dict[str, tuple[FaceDetection, ...]] = {}
    matched = None
    for count, name in enumerate(in_order):
        report(count / len(in_order))
        if name in found:  # looked at where a face must be that was not confirmed
            continue
        found[name] = find(scene.pyramids[name], scene.networks)
        if found[name] and (matched := scene.match(found)) is not None:
            found |= _look(scene, matched, found)
            matched = scene.match(found)
            if matched is not None and len(matched.detections) >= CONFIRMING_VIEWS:
                break
    return found, matched


def _look(
    scene: _Scene, matched: MatchedFaces, found: Mapping[str, tuple[FaceDetection, ...]]
) -> dict[str, tuple[FaceDetection, ...]]:
    """Looks for a face in the views in which it must be and was not found; what was found there comes after it."""
    looked = {}
    for name in _expected(matched, scene.rig):
        if name in matched.detections:
            continue
        crop = crop_around(scene.rig[name].project(matched.points_world))
        face = find_face_at(scene.pyramids[name], crop, scene.networks, rounds=PREDICTED_ROUNDS)
        if face.score >= MIN_SCORE:
            looked[name] = (face, *found.get(name, ()))
    return looked


def _expected(matched: MatchedFaces, rig: Rig) -> Iterator[str]:
    """The views towards which a face looks and whose pictures hold it."""
    looking = _towards(matched, rig)
    for camera in rig:
        pixels = camera.project(matched.points_world)
        size = (camera.intrinsics.width, camera.intrinsics.height)
        inside = ((pixels > -0.5) & (pixels < np.array(size) - 0.5)).all(axis=1)  # False where a pixel is NaN
        if looking[camera.name] >= MIN_FACING and inside.mean() > MIN_INSIDE and np.isfinite(pixels).all():
            yield camera.name


def _towards(matched: MatchedFaces, rig: Rig) -> dict[str, float]:
    """For each camera the cosine of the angle between where a face looks and the way to the camera."""
    towards = {camera.name: camera.centre_world - matched.points_world.mean(axis=0) for camera in rig}
    return {name: float(way @ matched.facing_world / np.linalg.norm(way)) for name, way in towards.items()}

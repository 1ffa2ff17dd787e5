"""Matching of faces across views, with planted ones: the subject's, others behind it, posters, and wrong detections."""

import numpy as np
import pytest

from pipeline.faces.detection import FaceDetection
from pipeline.faces.matching import EYE_DISTANCE_MM, MatchedFaces, complete_match, find_subject_face
from pipeline.faces.points import point_table
from rig.camera import Camera, Intrinsics
from rig.geometry import RigidTransform, Similarity, look_at, rotation_from_vector
from rig.rig import Rig
from tests.support.drawn_faces import seen_face

UP = np.array([0.0, 1.0, 0.0])
DIRECTIONS_DEG = ((0, 0), (-35, 10), (35, 10), (-60, 0), (60, 0), (0, 30), (10, -30))
SUBJECT = Similarity(1.0, rotation_from_vector(np.array([0.1, -0.15, 0.05])), np.array([5.0, -10.0, 20.0]))


def camera(
    name: str, azimuth_deg: float, elevation_deg: float, distance: float = 1100.0, roll_deg: float = 0.0
) -> Camera:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    away = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    pose = look_at(1100.0 * away, np.zeros(3), UP)
    turn = RigidTransform(rotation_from_vector(np.array([0.0, 0.0, np.radians(roll_deg)])), np.zeros(3))
    return Camera(name, Intrinsics(1024, 768, 1500.0, 1500.0, 520.0, 377.0), turn @ pose)


RIG = Rig(tuple(camera(f"cam{k}", *direction) for k, direction in enumerate(DIRECTIONS_DEG)))


def seen(
    face: Similarity, rig: Rig = RIG, seed: int = 0, **options: float | bool
) -> dict[str, tuple[FaceDetection, ...]]:
    rng = np.random.default_rng(seed)
    return {camera.name: (seen_face(face, camera, rng, **options),) for camera in rig}  # type: ignore[arg-type]


def both(*many: dict[str, tuple[FaceDetection, ...]]) -> dict[str, tuple[FaceDetection, ...]]:
    return {name: tuple(face for one in many for face in one.get(name, ())) for name in RIG.names}


def match_faces(
    candidates: dict[str, tuple[FaceDetection, ...]],
    rig: Rig,
    eye_distance_mm: tuple[float, float] | None = EYE_DISTANCE_MM,
) -> MatchedFaces | None:
    best = find_subject_face(candidates, rig, eye_distance_mm)
    return best and complete_match(best, candidates, rig)


def matched(candidates: dict[str, tuple[FaceDetection, ...]], rig: Rig = RIG, **options: object) -> MatchedFaces:
    found = match_faces(candidates, rig, **options)  # type: ignore[arg-type]
    assert found is not None
    return found


def errors_mm(found: MatchedFaces, face: Similarity = SUBJECT) -> np.ndarray:
    return np.linalg.norm(found.points_world - face.apply(point_table().shape_mm), axis=1)


def test_a_face_in_all_views_is_triangulated() -> None:
    found = matched(seen(SUBJECT))
    assert set(found.detections) == set(RIG.names)
    assert not found.outliers
    # 1 px of noise is 0.73 mm here; seven views around leave less of it in every direction.
    assert np.median(errors_mm(found)) < 0.73
    assert abs(found.relief - 1.0) < 0.02
    assert np.degrees(np.arccos(found.facing_world @ SUBJECT.rotation[:, 2])) < 0.5
    assert abs(found.world_from_face.scale - 1.0) < 0.01
    assert abs(found.eye_distance_mm - matched(seen(SUBJECT, seed=1)).eye_distance_mm) < 0.5


@pytest.mark.parametrize("names", [("cam0", "cam1"), ("cam1", "cam3"), ("cam0", "cam4"), ("cam3", "cam4")])
def test_two_views_are_enough(names: tuple[str, str]) -> None:
    rig = RIG.subset(names)
    found = matched(seen(SUBJECT, rig), rig)
    assert set(found.detections) == set(names)
    assert np.median(errors_mm(found)) < 2.5


@pytest.mark.parametrize("roll", [90.0, 180.0, -90.0, 33.0])
def test_cameras_may_be_turned(roll: float) -> None:
    rig = Rig(tuple(camera(f"cam{k}", *d, roll_deg=roll if k % 2 else 0.0) for k, d in enumerate(DIRECTIONS_DEG)))
    found = matched(seen(SUBJECT, rig), rig)
    assert set(found.detections) == set(RIG.names)
    assert np.median(errors_mm(found)) < 0.73


def test_a_poster_is_no_face() -> None:
    poster = Similarity(1.0, np.eye(3), np.array([60.0, 40.0, -150.0]))
    assert match_faces(seen(poster, flat=True), RIG) is None
    found = matched(both(seen(poster, seed=1, flat=True, score=50.0), seen(SUBJECT)))
    assert set(found.detections) == set(RIG.names)
    assert np.median(errors_mm(found)) < 0.73
    larger_and_close = Similarity(1.3, np.eye(3), np.array([10.0, 0.0, -60.0]))
    found = matched(both(seen(larger_and_close, seed=1, flat=True, score=50.0), seen(SUBJECT)))
    assert np.median(errors_mm(found)) < 0.73


def test_a_second_person_behind_is_another() -> None:
    behind = Similarity(1.0, np.eye(3), np.array([150.0, 30.0, -500.0]))
    found = matched(both(seen(behind, seed=1, score=50.0), seen(SUBJECT, score=20.0)))
    assert set(found.detections) == set(RIG.names)
    assert np.median(errors_mm(found)) < 0.73
    # Two people whom different views show do not mix.
    subject, other = seen(SUBJECT), seen(behind, seed=1)
    candidates = {name: other[name] if name in ("cam1", "cam4") else subject[name] for name in RIG.names}
    found = matched(candidates)
    assert set(found.detections) == set(RIG.names) - {"cam1", "cam4"}
    assert np.median(errors_mm(found)) < 0.9


def test_a_view_whose_face_is_elsewhere_is_left_out() -> None:
    candidates = seen(SUBJECT)
    rng = np.random.default_rng(3)
    candidates["cam2"] = (seen_face(SUBJECT, RIG["cam2"], rng, shift_px=(60.0, 25.0)),)
    found = matched(candidates)
    assert set(found.detections) == set(RIG.names) - {"cam2"}
    assert set(found.outliers) == {"cam2"}
    assert np.median(errors_mm(found)) < 0.9


def test_wrong_detections_alone_are_nobody() -> None:
    """Faces that were not there, in five views at five unrelated places."""
    rng = np.random.default_rng(11)
    places = [Similarity(1.0, rotation_from_vector(rng.normal(0, 0.3, 3)), rng.normal(0, 150.0, 3)) for _ in range(5)]
    candidates = {
        name: (seen_face(place, RIG[name], rng, score=5.0),) for name, place in zip(RIG.names, places, strict=False)
    }
    assert match_faces(candidates, RIG) is None


def test_nothing_one_view_and_cameras_at_one_place_are_nobody() -> None:
    assert match_faces({}, RIG) is None
    assert match_faces({name: () for name in RIG.names}, RIG) is None
    assert match_faces({"cam0": seen(SUBJECT)["cam0"]}, RIG) is None
    rig = Rig((camera("cam0", 0, 0), camera("cam1", 0, 0)))
    assert match_faces(seen(SUBJECT, rig), rig) is None


@pytest.mark.parametrize(("scale", "is_face"), [(0.4, False), (0.65, True), (1.25, True), (2.0, False)])
def test_size_in_millimetres_decides(scale: float, is_face: bool) -> None:
    """From an infant's to a large man's; a doll and a billboard are none, unless the rig's scale is not known."""
    face = Similarity(scale, SUBJECT.rotation, SUBJECT.translation)
    assert (match_faces(seen(face), RIG) is not None) == is_face
    assert match_faces(seen(face), RIG, eye_distance_mm=None) is not None


def test_a_mask_seen_from_behind_is_no_face() -> None:
    """A hollow face, whose points turn inside out."""
    hollow = Similarity(1.0, np.eye(3), np.zeros(3))
    rng = np.random.default_rng(5)
    candidates = {}
    for each in RIG:
        face = seen_face(hollow, each, rng)
        inside_out = each.project(hollow.apply(point_table().shape_mm * (1.0, 1.0, -1.0)))
        candidates[each.name] = (FaceDetection(inside_out, face.score, face.box_px, face.roll_deg),)
    assert match_faces(candidates, RIG) is None

"""A head is held against the faces that photographs show: in place, back to front, and where nobody found one."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.evidence.pose import angles_deg, cameras_in_front, judge_pose, pupil_distance, pupils
from pipeline.faces.detection import FaceDetection
from pipeline.faces.irises import BEHIND_MM, Iris, UnseenEye
from pipeline.faces.landmark_map import landmark_map
from pipeline.faces.subject import SubjectFaces, match_alone
from pipeline.head_model.model import HeadModel
from pipeline.results.report import eyes_document
from pipeline.results.report_types import EyeReport
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.rig import Rig
from rig.studio.scene.layout import default_layout, rig_from_directions

FACING = ("cam00", "cam01", "cam02")


@pytest.fixture(scope="module")
def rig() -> Rig:
    return default_layout()


def posed(turn_deg: float, rig: Rig, shift_mm: float = 0.0) -> Similarity:
    rotation = rotation_from_vector(np.radians([0.0, turn_deg, 0.0]))
    return Similarity(1.0, rotation, rig.centre_world() + np.array([shift_mm, 0.0, 0.0]))


def head_at(model: HeadModel, pose: Similarity) -> Mesh:
    return Mesh(pose.apply(model.vertices(np.zeros(0))), model.levels["full"].faces)


def faces_of(model: HeadModel, pose: Similarity, rig: Rig, names: tuple[str, ...]) -> SubjectFaces:
    """What the networks find of a mean head at ``pose``, without noise."""
    expected = pose.apply(landmark_map(model).expected(model.vertices(np.zeros(0))))
    found = {}
    for name in names:
        pixels = rig[name].project(expected)
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        found[name] = (FaceDetection(pixels, 40.0, box, 0.0),)
    return SubjectFaces(found, None, names)


def codes(model: HeadModel, pose: Similarity, rig: Rig, subject: SubjectFaces, rival: float | None = None) -> list[str]:
    places = landmark_map(model)
    _, warnings = judge_pose(head_at(model, pose), pose, rig, subject, places, method="silhouettes", rival=rival)
    return [warning.code for warning in warnings]


def test_a_head_where_the_face_is_is_doubted_for_a_rival_that_it_does_not_beat(model: HeadModel, rig: Rig) -> None:
    pose = posed(0.0, rig)
    seen = faces_of(model, pose, rig, FACING)
    evidence, warnings = judge_pose(head_at(model, pose), pose, rig, seen, landmark_map(model), method="x", rival=0.5)
    assert (warnings, evidence.doubtful) == ([], False)
    assert max(evidence.off.values()) < 1e-6
    assert codes(model, pose, rig, seen, rival=0.01) == ["pose-doubtful"]


@pytest.mark.parametrize(("turn_deg", "shift_mm"), [(180.0, 0.0), (45.0, 0.0), (0.0, 60.0)])
def test_a_face_that_lies_elsewhere_is_said(model: HeadModel, rig: Rig, turn_deg: float, shift_mm: float) -> None:
    subject = faces_of(model, posed(0.0, rig), rig, FACING)
    assert codes(model, posed(turn_deg, rig, shift_mm), rig, subject) == ["face-elsewhere"]


def test_one_wrong_view_of_three_says_nothing_of_the_pose(model: HeadModel, rig: Rig) -> None:
    pose = posed(0.0, rig)
    subject = faces_of(model, pose, rig, FACING)
    (wrong,) = faces_of(model, posed(0.0, rig, 80.0), rig, ("cam02",)).found["cam02"]
    mixed = SubjectFaces({**subject.found, "cam02": (wrong,)}, None, FACING)
    assert codes(model, pose, rig, mixed) == []


def test_no_face_before_cameras_that_must_see_one(model: HeadModel, rig: Rig) -> None:
    pose = posed(0.0, rig)
    assert len(cameras_in_front(pose, rig)) >= 3
    nobody = SubjectFaces({name: () for name in rig.names}, None, ())
    assert codes(model, pose, rig, nobody) == ["no-face"]
    away = posed(180.0, rig)
    assert codes(model, away, rig, nobody) == ([] if len(cameras_in_front(away, rig)) < 2 else ["no-face"])
    narrow = rig_from_directions([(-12.0, 0.0), (0.0, 0.0), (12.0, 0.0)])  # outlines of one side alone
    pose = posed(0.0, narrow)
    nobody = SubjectFaces({name: () for name in narrow.names}, None, ())
    assert codes(model, pose, narrow, nobody) == ["no-face", "pose-doubtful"]


def test_one_view_tells_a_face_elsewhere_unless_doubtful_and_leaves_a_pose_in_doubt(model: HeadModel, rig: Rig) -> None:
    pose = posed(0.0, rig)
    seen = faces_of(model, pose, rig, FACING[:1])
    assert "face-elsewhere" in codes(model, posed(60.0, rig), rig, seen)
    doubtful = {name: tuple(replace(face, score=3.0) for face in faces) for name, faces in seen.found.items()}
    assert "face-elsewhere" not in codes(model, posed(60.0, rig), rig, replace(seen, found=doubtful))
    for score, times in ((40.0, 1), (20.0, 2)):  # the second face is unclear, too
        alone = match_alone(FACING[0], replace(seen.found[FACING[0]][0], score=score), rig[FACING[0]])
        assert codes(model, pose, rig, replace(seen, matched=alone)) == times * ["pose-doubtful"]


BALLS = {"right": np.array([-31.0, 0.0, 0.0]), "left": np.array([31.5, 0.0, 0.0])}


def looking_at(
    target: tuple[float, float, float], std_mm: float = 0.1, std_deg: float = 1.0
) -> dict[str, Iris | UnseenEye]:
    out: dict[str, Iris | UnseenEye] = {}
    for side, ball in BALLS.items():
        gaze = (target - ball) / np.linalg.norm(target - ball)
        across = np.eye(3) - np.outer(gaze, gaze)
        covariance = np.zeros((7, 7))
        covariance[:3, :3] = std_mm**2 * np.eye(3)
        covariance[3:6, 3:6] = np.radians(std_deg) ** 2 * across
        out[side] = Iris(ball + BEHIND_MM * gaze, gaze, 5.85, covariance, ("cam0", "cam1"))
    return out


@pytest.mark.parametrize("target", [(0.0, 0.0, 1e9), (0.0, 0.0, 400.0), (300.0, 100.0, 900.0)])
def test_the_far_pupil_distance_is_the_same_wherever_the_eyes_look(target: tuple[float, float, float]) -> None:
    found = pupil_distance(looking_at(target))
    assert found is not None
    assert found.value_mm == pytest.approx(62.5)


def test_its_deviation_is_that_of_both_centres_and_gazes_and_it_needs_both_eyes() -> None:
    eyes = looking_at((0.0, 0.0, 1e9))
    found = pupil_distance(eyes)
    assert found is not None
    assert found.std_mm == pytest.approx(np.hypot(0.1, BEHIND_MM * np.radians(1.0)) * 2**0.5, rel=1e-3)
    one = eyes | {"left": UnseenEye("closed")}
    assert (pupil_distance(one), pupils(one), pupils({})) == (None, {}, {})


def test_angles_are_to_the_left_and_up() -> None:
    assert angles_deg(np.array([0.0, 0.0, 1.0])) == pytest.approx((0.0, 0.0))
    assert angles_deg(np.array([np.sin(0.2), 0.0, np.cos(0.2)])) == pytest.approx((np.degrees(0.2), 0.0))
    assert angles_deg(np.array([0.0, np.sin(0.3), np.cos(0.3)])) == pytest.approx((0.0, np.degrees(0.3)))


def test_the_report_says_gaze_in_both_frames_or_why_there_is_none() -> None:
    turn = rotation_from_vector(np.array([0.0, 0.4, 0.0]))
    eyes = looking_at((0.0, 0.0, 1e9)) | {"left": UnseenEye("coarse")}
    document = eyes_document(eyes, Similarity(1.1, turn, np.ones(3)))
    right, left = document["right"], document["left"]
    assert right.keys() == left.keys() == EyeReport.__annotations__.keys()
    assert right["rig"] == pytest.approx({"azimuth_deg": 0.0, "elevation_deg": 0.0}, abs=1e-4)
    assert right["face"] == pytest.approx({"azimuth_deg": np.degrees(-0.4), "elevation_deg": 0.0}, abs=1e-4)
    assert right["std_deg"] == pytest.approx(1.0)
    assert (left["seen"], left["cause"], left["iris"], left["views"]) == (False, "coarse", None, [])

"""Pupil distance and angles of the gaze."""

import numpy as np
import pytest

from pipeline.evidence.pose import angles_deg, pupil_distance, pupils
from pipeline.faces.irises import BEHIND_MM, Iris, UnseenEye
from pipeline.results.report import eyes_document
from pipeline.results.report_types import EyeReport
from rig.geometry import Similarity, rotation_from_vector

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

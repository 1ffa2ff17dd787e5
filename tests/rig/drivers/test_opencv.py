"""Video devices: which settings count as taken."""

import cv2
import pytest

from rig.drivers import opencv

FOURCC = cv2.VideoWriter.fourcc


@pytest.mark.parametrize(
    ("prop", "wanted", "found", "is_taken"),
    [
        (cv2.CAP_PROP_FOURCC, FOURCC(*"MJPG"), FOURCC(*"MJPG"), True),
        (cv2.CAP_PROP_FOURCC, FOURCC(*"MJPG"), FOURCC(*"JPEG"), False),  # 0.3 % apart as numbers
        (cv2.CAP_PROP_FOURCC, FOURCC(*"NV12"), FOURCC(*"YU12"), False),
        (cv2.CAP_PROP_EXPOSURE, 83.0, 80.0, True),
        (cv2.CAP_PROP_FRAME_WIDTH, 1920, 1280, False),
    ],
)
def test_a_setting_is_taken(prop: int, wanted: float, found: float, is_taken: bool) -> None:
    assert opencv._is_taken(prop, wanted, found) == is_taken

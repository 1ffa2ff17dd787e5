"""Pupils of painted eyes: a dark disc in an iris, with a lamp's reflection beside it."""

import numpy as np
import pytest

from pipeline.faces.irises import pupils_px
from pipeline.faces.limbus import EyeView
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at

SIZE, FOCAL_PX, AWAY_MM = 80, 2400.0, 1200.0  # 2 px/mm
AXES = np.eye(3)[:2]
BROWN, DARK, WHITE, LAMP = 0.15, 0.02, 1.0, 3.0  # brightness, by the white's


def eye(
    pupil_mm: tuple[float, float], *, dark: float = DARK, highlight_mm: tuple[float, float] | None = None
) -> EyeView:
    """An eye in the plane z = 0, straight ahead, as a view has it."""
    middle = (SIZE - 1) / 2
    lens = Intrinsics(SIZE, SIZE, FOCAL_PX, FOCAL_PX, middle, middle)
    pose = look_at(np.array([0.0, 0.0, AWAY_MM]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    x, y = np.meshgrid(np.arange(SIZE) - middle, middle - np.arange(SIZE))
    across, up = x * AWAY_MM / FOCAL_PX, y * AWAY_MM / FOCAL_PX
    brightness = np.where(np.hypot(across, up) < 5.85, BROWN, WHITE)
    brightness[np.hypot(across - pupil_mm[0], up - pupil_mm[1]) < 2.0] = dark
    if highlight_mm is not None:
        brightness[np.hypot(across - highlight_mm[0], up - highlight_mm[1]) < 0.5] = LAMP
    plane = np.zeros((SIZE, SIZE), np.float32)
    return EyeView(Camera("cam0", lens, pose), np.zeros(2), brightness.astype(np.float32), plane, plane)


@pytest.mark.parametrize("highlight", [None, (-1.2, 1.0)])
def test_a_pupil_is_found_beside_a_highlight(highlight: tuple[float, float] | None) -> None:
    views = [eye(place, highlight_mm=highlight) for place in ((0.6, -0.4), (-0.5, 0.3))]
    found = pupils_px(views, np.zeros(3), AXES)
    for view, place, pixel in zip(views, ((0.6, -0.4), (-0.5, 0.3)), found, strict=True):
        assert pixel is not None
        assert np.linalg.norm(pixel - view.camera.project(np.array([[*place, 0.0]]))[0]) < 0.5


def test_an_iris_without_a_pupil_has_none() -> None:
    assert pupils_px([eye((0.0, 0.0), dark=BROWN)], np.zeros(3), AXES) == [None]
    assert pupils_px([], np.zeros(3), AXES) == []

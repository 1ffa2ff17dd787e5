"""Charts drawn here, warped and tinted by known matrices, pictures in which there is none, and plates."""

import cv2
import numpy as np
import pytest

from pipeline.imaging import colour_chart
from pipeline.imaging.colour_chart import (
    Chart,
    chart_correction,
    chart_normal,
    empty_plates,
    find_chart,
    find_charts,
    true_colours,
)
from rig.camera import Camera, Intrinsics
from rig.colour_space import srgb_from_linear
from rig.geometry import look_at
from tests.support.colour_chart_pictures import HEIGHT_MM, WIDTH_MM, chart_picture

TINT = np.array([[0.62, 0.05, 0.01], [0.03, 0.80, 0.04], [0.02, 0.06, 0.55]])


def photograph(corners: np.ndarray, tint: np.ndarray = TINT, seed: int = 0) -> np.ndarray:
    """A chart on a grey wall, with two levels of noise; ``corners``: px, from its upper left, clockwise."""
    wall = np.linspace(0.18, 0.30, 640, dtype=np.float32)[None, :, None] * np.ones((480, 1, 3), np.float32)
    chart = chart_picture(true_colours())
    height, width = chart.shape[:2]
    place = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    matrix = cv2.getPerspectiveTransform(place, corners.astype(np.float32))
    linear = cv2.warpPerspective(chart, matrix, (640, 480), dst=wall, borderMode=cv2.BORDER_TRANSPARENT)
    codes = 255 * srgb_from_linear(linear @ tint.T) + np.random.default_rng(seed).normal(0, 2, linear.shape)
    return np.clip(np.rint(codes), 0, 255).astype(np.uint8)


def placed(width: float, turn_deg: float, middle: tuple[float, float] = (320, 240)) -> np.ndarray:
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, width * HEIGHT_MM / WIDTH_MM / 2)
    turn = np.radians(turn_deg)
    return half @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + middle


def test_the_reference_is_that_of_the_published_chart() -> None:
    """X-Rite's sRGB codes of some patches, by which another order, gamma or white point would be told."""
    codes = 255 * srgb_from_linear(true_colours())
    published = {0: (115, 82, 68), 13: (70, 148, 73), 14: (175, 54, 60), 18: (243, 243, 242), 23: (52, 52, 52)}
    for patch, wanted in published.items():
        np.testing.assert_allclose(codes[patch], wanted, atol=6)


@pytest.mark.parametrize(("width", "turn_deg"), [(90, 5), (200, -12), (200, 180), (420, 8)])
def test_a_chart_is_found_however_it_is_turned_and_its_tint_taken_back(width: float, turn_deg: float) -> None:
    corners = placed(width, turn_deg)
    chart = find_chart(photograph(corners))
    assert chart is not None
    towards_last = chart.centres[23] - chart.centres[0]
    assert towards_last @ (corners[2] - corners[0]) > 0.9 * np.linalg.norm(towards_last) * width, "dark skin is first"
    correction = chart_correction([chart])
    assert correction is not None
    np.testing.assert_allclose(correction.matrix @ TINT, np.eye(3), atol=0.03)
    assert correction.off < 0.01


def test_pictures_without_a_chart_have_none() -> None:
    squares = np.kron(np.indices((12, 16)).sum(axis=0) % 2, np.ones((40, 40)))[..., None] * np.ones(3)
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3))
    for picture in (255 * squares, noise, np.zeros((480, 640, 3)), np.full((8, 8, 3), 200)):
        assert find_chart(picture.astype(np.uint8)) is None


def test_a_chart_of_other_colours_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """The patches in any other order are far from what a matrix takes back."""
    mixed = [np.random.default_rng(seed).permutation(true_colours()) for seed in range(20)]
    charts = [Chart(np.zeros((24, 2)), colours) for colours in mixed]
    assert all(chart_correction([chart]) is None for chart in charts)
    monkeypatch.setattr(colour_chart, "MAX_OFF", 1.0)
    assert min(found.off for found in map(chart_correction, [[chart] for chart in charts]) if found) > 0.2


def test_a_few_clipped_patches_are_left_out_and_an_overexposed_chart_tells_nothing() -> None:
    some, most = (
        chart_correction([Chart(np.zeros((24, 2)), np.minimum(gain * true_colours(), 1.0))]) for gain in (1.5, 6.0)
    )
    assert some is not None
    np.testing.assert_allclose(some.matrix, np.eye(3) / 1.5, atol=1e-6)
    assert most is None


def test_the_way_that_a_chart_faces() -> None:
    eye, middle = np.array([300.0, 200.0, 1500.0]), np.array([20.0, -30.0, 40.0])
    camera = Camera("a", Intrinsics(640, 480, 900.0, 900.0, 319.5, 239.5), look_at(eye, middle, np.array([0, 1.0, 0])))
    normal = np.array([0.5, 0.1, 0.86]) / np.linalg.norm([0.5, 0.1, 0.86])
    right = np.cross((0, 1.0, 0), normal)
    right /= np.linalg.norm(right)
    grid = np.stack(np.meshgrid(np.arange(6) - 2.5, 1.5 - np.arange(4)), axis=-1).reshape(-1, 2) * 46.0
    points = middle + grid @ np.stack([right, np.cross(normal, right)])
    found = chart_normal(Chart(camera.project(points), true_colours()), camera)
    np.testing.assert_allclose(found, normal, atol=1e-3)


WALL = photograph(placed(0.01, 0.0), np.eye(3))
CHART = photograph(placed(200, 5), np.eye(3))


def noisy(seed: int, level: float = 1.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 3, WALL.shape)
    return np.clip(np.rint(level * WALL + noise), 0, 255).astype(np.uint8)


def test_the_plate_with_the_chart_is_left_out_unless_it_is_the_only_one() -> None:
    plates = (noisy(1), CHART, noisy(2, 1.1))
    assert [plate is CHART for plate in empty_plates(plates)] == [False, False]
    assert len(find_charts(plates)) == 1
    assert empty_plates((CHART,)) == (CHART,)
    assert len(find_charts((CHART,))) == 1
    assert find_charts(()) == []


def test_plates_that_are_alike_are_all_kept_and_the_first_is_looked_at() -> None:
    plates = (noisy(1), noisy(2, 0.8))
    assert empty_plates(plates) == plates
    assert find_charts(plates) == []
    hung = (CHART, photograph(placed(200, 5), np.eye(3), seed=1))
    assert empty_plates(hung) == hung, "a chart that hangs at the wall is in the shot, too"
    assert len(find_charts(hung)) == 1
    walked = noisy(3)
    walked[100:400, 200:300] = 20  # somebody walks through the picture
    plates = (noisy(1), walked)
    assert empty_plates(plates) == plates

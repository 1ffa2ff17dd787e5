"""Clean plates, one of which shows a chart."""

import numpy as np

from pipeline.imaging.colour_chart import charts_in, empty_plates
from tests.pipeline.imaging.test_colour_chart import photograph, placed

WALL = photograph(placed(0.01, 0.0), np.eye(3))
CHART = photograph(placed(200, 5), np.eye(3))


def noisy(seed: int, level: float = 1.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 3, WALL.shape)
    return np.clip(np.rint(level * WALL + noise), 0, 255).astype(np.uint8)


def test_the_plate_with_the_chart_is_left_out_unless_it_is_the_only_one() -> None:
    plates = (noisy(1), CHART, noisy(2, 1.1))
    assert [plate is CHART for plate in empty_plates(plates)] == [False, False]
    assert len(charts_in(plates)) == 1
    assert empty_plates((CHART,)) == (CHART,)
    assert len(charts_in((CHART,))) == 1
    assert charts_in(()) == []


def test_plates_that_are_alike_are_all_kept_and_the_first_is_looked_at() -> None:
    plates = (noisy(1), noisy(2, 0.8))
    assert empty_plates(plates) == plates
    assert charts_in(plates) == []
    hung = (CHART, photograph(placed(200, 5), np.eye(3), seed=1))
    assert empty_plates(hung) == hung, "a chart that hangs at the wall is in the shot, too"
    assert len(charts_in(hung)) == 1
    walked = noisy(3)
    walked[100:400, 200:300] = 20  # somebody walks through the picture
    plates = (noisy(1), walked)
    assert empty_plates(plates) == plates

"""Pictures of a model show what they say: sizes to scale, voids where they are, curves at their values."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.applications.model_building.training.figures import LINES, PANEL, chart, modes_figure, shaded, show_model
from pipeline.head_model.model import HeadModel, with_modes


def height(image: np.ndarray) -> int:
    rows = np.flatnonzero((image < 250).any(axis=(1, 2)))
    return int(rows[-1] - rows[0])


def test_all_heads_are_drawn_to_one_scale(model: HeadModel) -> None:
    """A head 10 % larger is 10 % taller in the picture, give or take two pixels and perspective (100 of 1600 mm)."""
    head, faces = model.vertices(np.zeros(0), "p95"), model.levels["p95"].faces
    tall, low = height(shaded(head * 1.1, faces)), height(shaded(head, faces))
    assert tall == pytest.approx(1.1 * low, abs=2 + 0.01 * low)


def test_voids_are_red_and_nothing_else(model: HeadModel) -> None:
    head, faces = model.vertices(np.zeros(0), "p95"), model.levels["p95"].faces

    def red(marked: np.ndarray) -> np.ndarray:
        image = shaded(head, faces, marked, azimuth_rad=0.0).astype(int)
        return image[:, :, 0] - image[:, :, 1] > 60

    assert not red(np.zeros(len(head), bool)).any()
    left = red(head[:, 0] > 15)  # the subject's left is on the right of a picture from the front
    assert left[:, PANEL[0] // 2 + 15 :].sum() > 3000
    assert not left[:, : PANEL[0] // 2].any()


def test_modes_stand_left_and_right_of_the_mean(model: HeadModel) -> None:
    image = modes_figure(model, 2)
    assert image.shape == (2 * PANEL[1], 3 * PANEL[0], 3)
    first, second = image[: PANEL[1]], image[PANEL[1] :]
    middle = slice(PANEL[0], 2 * PANEL[0])
    np.testing.assert_array_equal(first[30:, middle], second[30:, middle])
    assert (first[30:, : PANEL[0]] != first[30:, 2 * PANEL[0] :]).mean() > 0.1


def test_a_curve_runs_at_its_values() -> None:
    """A straight line from (0, 0) to (10, 1): the drawn pixels rise by the height of the axes over their width."""
    image = chart("line", {k: k / 10 for k in range(11)}, LINES[0])
    drawn = (np.abs(image.astype(int) - LINES[0]).sum(2) < 30).nonzero()
    slope, start = np.polyfit(drawn[1], drawn[0], 1)
    assert slope == pytest.approx(-(275 - 40) / (420 - 55 - 20), abs=0.01)
    assert start + slope * 55 == pytest.approx(275, abs=1.5)


@pytest.mark.slow
def test_show_writes_three_pictures(tmp_path: Path, model: HeadModel) -> None:
    stages: list[str] = []
    written = show_model(with_modes(model, 3), tmp_path / "new", modes=1, report=lambda stage, _: stages.append(stage))
    assert [path.name for path in written] == ["modes.png", "correspondence.png", "curves.png"]
    for path in written:
        image = cv2.imread(str(path))
        assert image is not None
        assert 0.02 < (image < 250).mean() < 0.9
    assert "leaving one out" in stages

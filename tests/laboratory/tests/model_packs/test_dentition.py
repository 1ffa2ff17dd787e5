"""Rows of teeth along an arch."""

import numpy as np
import pytest

from pipeline.fusion.crossings import crossing_faces
from rig.mesh import boundary_edges
from tests.laboratory.model_packs.dentition import GUM, LOWER, UPPER, Crown, row_of_teeth


def arch() -> np.ndarray:
    """Half an ellipse as wide as an adult's arch, from right to left."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17)
    return np.stack([32.0 * np.sin(angle), np.full(17, -50.0), 30.0 + 48.0 * np.cos(angle)], axis=1)


@pytest.mark.parametrize(("crowns", "up"), [(UPPER, 1.0), (LOWER, -1.0)])
def test_a_row_is_closed_does_not_cross_itself_and_stands_on_its_side_of_the_line(
    crowns: tuple[Crown, ...], up: float
) -> None:
    row = row_of_teeth(arch(), crowns, up=up)
    assert not len(boundary_edges(row.faces))
    assert not crossing_faces(row.vertices, row.faces).any()
    above = up * (row.vertices[:, 1] + 50.0)
    assert -0.01 < above.min() < 0.5
    assert above.max() == pytest.approx(max(crown.height for crown in crowns) + 5.0, abs=1.5)
    front = np.abs(row.vertices[:, 0]) < 3.0
    assert row.vertices[front, 2].max() == pytest.approx(78.0, abs=1.0)
    mirrored = np.sort(-row.vertices[:, 0])
    np.testing.assert_allclose(np.sort(row.vertices[:, 0]), mirrored, atol=1e-6)


def test_gums_are_coloured_above_the_crowns() -> None:
    row = row_of_teeth(arch(), UPPER, up=1.0)
    gum = (np.asarray(row.colours) == GUM).all(axis=1)
    height = row.vertices[:, 1] + 50.0
    assert height[gum].min() > 4.5  # between molars
    assert height[~gum].max() < 10.6

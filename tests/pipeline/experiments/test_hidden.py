"""Seen and hidden skin of a planted sphere."""

import numpy as np
import pytest

from pipeline.experiments.detail import Known
from pipeline.experiments.hidden import figures, skin_figures
from rig.capture import Capture
from rig.mesh import Mesh
from rig.studio.scene.layout import default_layout
from rig.studio.scene.visible import VisiblePoints
from tests.support.scenes import ellipsoid

OFF_MM, STATED_MM = 1.0, 0.3


def planted() -> tuple[Known, Mesh]:
    """A head whose front is seen, and one that is right there and a millimetre too large behind."""
    truth = ellipsoid(4)
    front = truth.vertices[:, 2] > 0.0
    seen = truth.vertices[front].astype(np.float32)
    count = len(seen)
    visible = VisiblePoints(
        seen, truth.normals()[front].astype(np.float32), np.zeros(count, np.uint8), np.full(count, 3, np.uint8)
    )
    off = np.where(front, 0.0, OFF_MM)[:, None] * truth.normals()
    known = Known("ball", Capture({}, {}), default_layout(), truth, front, visible)
    return known, Mesh(truth.vertices + off, truth.faces)


def test_seen_and_hidden_skin_are_told_apart_by_region() -> None:
    known, found = planted()
    left = found.vertices[:, 0] > 0.0
    said = skin_figures(known, found, np.full(len(left), STATED_MM), {"left": left, "none": np.zeros(len(left), bool)})
    assert said["seen_all_median_mm"] == pytest.approx(0.0, abs=0.02)
    assert said["hidden_left_median_mm"] == pytest.approx(OFF_MM, abs=0.05)
    assert said["hidden_all_stated_mm"] == pytest.approx(STATED_MM)
    # 1.96 times what is stated holds the front and not the back; at the border between them a facet is half off.
    assert said["seen_left_within_95"] > 0.95
    assert said["hidden_left_within_95"] < 0.05
    assert not any("none" in key for key in said)


def test_figures_are_means_of_a_group() -> None:
    rows = [{"name": "a", "group": "studio", "level": "fine", "seen_all_median_mm": 0.1},
            {"name": "b", "group": "studio", "level": "fine", "seen_all_median_mm": 0.3},
            {"name": "scan", "group": "scan", "level": "photo", "hidden_ears_within_95": 0.9}]  # fmt: skip
    assert figures(rows) == pytest.approx({"studio_seen_all_median_mm": 0.2, "scan_hidden_ears_within_95": 0.9})

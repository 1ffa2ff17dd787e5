"""Seen and hidden skin of a planted sphere."""

import numpy as np
import pytest

from pipeline.evidence.measurements import Landmark, Measurement
from rig.capture import Capture
from rig.mesh import Mesh
from rig.studio.scene.layout import default_layout
from rig.studio.scene.visible import VisiblePoints
from tests.laboratory.experiments.paper.detail import Known
from tests.laboratory.experiments.surface.hidden import (
    as_markdown,
    figures,
    landmark_figures,
    reached_from_outside,
    skin_figures,
)
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


def test_a_cavity_is_nobodys_skin() -> None:
    """A sphere within a sphere: nothing from outside reaches the inner one; alone it is seen all over."""
    inner, outer = ellipsoid(3), ellipsoid(3)
    both = Mesh(
        np.concatenate([0.5 * inner.vertices, outer.vertices]),
        np.concatenate([inner.faces, outer.faces + len(inner.vertices)]),
    )
    reached = reached_from_outside(both)
    assert not reached[: len(inner.vertices)].any()
    assert reached[len(inner.vertices) :].all()
    assert reached_from_outside(inner).all()


def test_landmarks_count_by_coordinate_and_measurements_by_length() -> None:
    true = {"cheilion_right": np.zeros(3), "cheilion_left": np.array([50.0, 0.0, 0.0])}
    found = {
        "cheilion_right": Landmark(np.array([0.5, 0.0, 3.0]), np.full(3, 1.0)),
        "cheilion_left": Landmark(np.array([51.0, 3.0, 3.0]), np.full(3, 1.0)),
        "gonion_left": Landmark(np.zeros(3), np.full(3, 1.0)),  # of no known place
    }
    said = landmark_figures(
        true, found, {"mouth_breadth": Measurement(52.0, 1.5), "nose_length": Measurement(1.0, 1.0)}
    )
    assert said["landmarks_within_95"] == pytest.approx(0.5)  # three of six are three deviations off
    assert said["landmarks_stated_mm"] == pytest.approx(np.sqrt(3.0))
    assert said["measurements_median_mm"] == pytest.approx(2.0)
    assert said["measurements_within_95"] == 1.0
    assert landmark_figures({}, found, {}) == {}


def test_figures_are_means_of_a_group_and_of_all_populations() -> None:
    rows = [{"name": "a", "group": "studio", "fine": {"reached": "fine", "seen_all_median_mm": 0.1}},
            {"name": "b", "group": "draws", "fine": {"reached": "fine", "seen_all_median_mm": 0.3}},
            {"name": "c", "group": "draws-real", "fine": {"reached": "fine", "seen_all_median_mm": 0.4}},
            {"name": "scan", "group": "scan", "photo": {"reached": "photo", "hidden_ears_within_95": 0.9}}]  # fmt: skip
    expected = {"studio": 0.1, "draws": 0.3, "all": 0.2, "draws-real": 0.4, "all-real": 0.4}
    found = figures(rows)
    assert {name: found[f"{name}_fine_seen_all_median_mm"] for name in expected} == pytest.approx(expected)
    assert found["scan_photo_hidden_ears_within_95"] == pytest.approx(0.9)
    assert len(found) == 6


def test_the_table_has_a_row_for_each_group_and_level() -> None:
    found = {f"studio_fine_seen_all_{what}": value for what, value in
             {"within_95": 0.95, "median_mm": 0.1, "stated_mm": 0.2}.items()}  # fmt: skip
    assert "| studio fine | 0.95 / 0.1 / 0.2 |" in as_markdown(found)

"""Points of the wedge, against the planes that it was drawn from."""

import numpy as np

from pipeline.multiview.scene_tracks import find_scene_points, neighbouring_pairs
from tests.support.textured_wedge import SLOPE, photograph, wedge_rig


def test_points_lie_on_the_wedge() -> None:
    rig = wedge_rig()
    images = {c.name: np.repeat(photograph(c)[:, :, None], 3, axis=2) for c in rig}
    found = find_scene_points(images, rig)
    assert len(found.points) > 300
    off = np.abs(found.points[:, 2] + SLOPE * np.abs(found.points[:, 0])) / np.hypot(1, SLOPE)
    # A keypoint's 0.3 px at 420 mm and f = 460 is 0.27 mm across; in depth, over 12 degrees, five times that.
    assert np.median(off) < 1.4
    assert np.quantile(off, 0.95) < 10
    for name, rows in found.rows.items():
        miss = np.linalg.norm(rig[name].project(found.points[rows]) - found.pixels[name], axis=1)
        assert miss.max() < 1.5


def test_only_views_from_nearly_the_same_side_are_compared() -> None:
    rig = wedge_rig((-80.0, -70.0, 70.0, 80.0))
    assert neighbouring_pairs(rig) == [("cam00", "cam01"), ("cam02", "cam03")]

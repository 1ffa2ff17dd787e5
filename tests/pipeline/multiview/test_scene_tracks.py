"""Points in three views or more: exact pixels miss nothing, and points of too few views are left out.

What keypoints of drawn pictures come to is tested where they are used (``test_lens_distortion``).
"""

import numpy as np
import pytest

from pipeline.multiview.scene_tracks import SceneTracks, find_scene_points, misses_px, neighbouring_pairs
from rig.studio.scene.layout import default_layout
from tests.support.textured_wedge import SLOPE, photograph, wedge_rig

RIG = default_layout()


@pytest.fixture
def tracks() -> SceneTracks:
    """Two points, in four cameras and in three."""
    points = RIG.centre_world() + np.array([[30.0, -20.0, 10.0], [-40.0, 15.0, 5.0]])
    seen = [(0, k) for k in (0, 1, 2, 3)] + [(1, k) for k in (2, 4, 5)]
    pixels = [RIG.cameras[camera].project(points[point][None])[0] for point, camera in seen]
    return SceneTracks(np.array([p for p, _ in seen]), np.array([c for _, c in seen]), np.array(pixels))


def test_exact_pixels_miss_nothing_and_a_wrong_one_does(tracks: SceneTracks) -> None:
    assert np.abs(misses_px(tracks, RIG)).max() < 1e-6
    off = SceneTracks(tracks.points, tracks.cameras, tracks.pixels + np.eye(7)[:, :1] * (0.0, 4.0))
    missed = np.linalg.norm(misses_px(off, RIG), axis=1)
    assert missed.argmax() == 0
    assert 1.0 < missed[0] < 4.0
    assert missed[4:].max() < 1e-6


def test_points_of_which_too_few_observations_are_left_are_left_out(tracks: SceneTracks) -> None:
    left = tracks.chosen(np.arange(7) != 0)
    assert (left.count, len(left.points)) == (2, 6)
    left = tracks.chosen(np.arange(7) != 5)
    assert (left.count, left.points.tolist(), left.cameras.tolist()) == (1, [0] * 4, [0, 1, 2, 3])
    assert tracks.chosen(np.zeros(7, bool)).count == 0


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

"""Points in three views or more: exact pixels miss nothing, and points of too few views are left out.

What keypoints of drawn pictures come to is tested where they are used (``test_lens_distortion``).
"""

import numpy as np
import pytest

from pipeline.multiview.scene_tracks import SceneTracks, misses_px
from rig.studio.scene.layout import default_layout

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

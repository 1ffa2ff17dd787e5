"""The dense stage's depth: planted balls are found to what the noise allows, hidden and blank ones are not made up."""

import os

import numpy as np
import pytest

from pipeline.stereo.depth_map import DepthMap, points_world
from pipeline.stereo.estimate import estimate_depth, replace_specks
from rig.camera import Distortion
from rig.rig import Rig
from tests.pipeline.stereo.ray_scene import Ball, fan, first_hit, shoot

pytestmark = pytest.mark.slow


def quiet(stage: str, fraction: float) -> None:
    assert stage == "dense"
    assert 0.0 <= fraction <= 1.0


def estimate(rig: Rig, balls: tuple[Ball, ...]) -> tuple[DepthMap, ...]:
    images, silhouettes = shoot(rig, balls)
    return estimate_depth(images, silhouettes, rig, None, report=quiet)


def depth_errors(depth_map: DepthMap, balls: tuple[Ball, ...]) -> np.ndarray:
    """Error along the ray of every known pixel, mm; not finite where the ray misses."""
    row, column = np.nonzero(depth_map.known)
    true, _ = first_hit(depth_map.camera, np.stack([column, row], axis=1).astype(float), balls)
    return np.linalg.norm(points_world(depth_map) - depth_map.camera.centre_world, axis=1) - true


def ball_pixels(depth_map: DepthMap, balls: tuple[Ball, ...]) -> int:
    """How many pixels show a ball."""
    row, column = np.indices(depth_map.depth_mm.shape).reshape(2, -1)
    return int(np.isfinite(first_hit(depth_map.camera, np.stack([column, row], axis=1).astype(float), balls)[0]).sum())


def test_ball_is_found_to_the_noise_of_its_texture_and_nothing_is_told_elsewhere() -> None:
    # A pixel is 1 mm; matches are good to 0.1 px, neighbours 25 degrees apart: 0.1 / tan 25 = 0.21 mm a pair. The outer
    # views share half of what they see with others, at 50 degrees and more the ball is too flat to compare.
    rig, balls = fan(5, 25.0, Distortion(k1=-0.05, p1=0.001)), (Ball(),)
    maps = estimate(rig, balls)
    assert [each.camera.name for each in maps] == list(rig.names)
    for each in maps:
        error = depth_errors(each, balls)
        assert np.isfinite(error).all()
        assert np.median(np.abs(error)) < 0.21
        assert np.mean(np.abs(error) < 2.0) > 0.97
        assert each.known.sum() > 0.45 * ball_pixels(each, balls)
        outward = points_world(each) / balls[0].radius
        assert np.median((outward * each.normal[each.known]).sum(axis=1)) > np.cos(np.radians(5.0))
        measured = (each.depth_mm != 0.0) | (each.normal != 0.0).any(axis=2) | (each.views != 0)
        np.testing.assert_array_equal(measured, each.known)
        assert (each.views[each.known] >= 2).all()


def test_ball_before_another_hides_it() -> None:
    # What the small ball hides from a view must not be taken for its surface, nor the small one for the large one's.
    balls = (Ball(), Ball(centre=(15.0, 5.0, 95.0), radius=22.0))
    for each in estimate(fan(5, 18.0), balls):
        error = depth_errors(each, balls)
        assert np.mean(np.abs(error) < 2.0) > 0.95


def test_a_blank_ball_and_views_without_a_neighbour_are_met_with_silence() -> None:
    balls = (Ball(contrast=0.0),)
    for each in estimate(fan(4, 20.0), balls):
        assert each.known.sum() < 0.03 * ball_pixels(each, balls)
    rig, balls = fan(3, 80.0), (Ball(),)  # 80 degrees apart
    assert not any(each.known.any() for each in estimate(rig, balls))


def test_result_does_not_depend_on_the_number_of_threads() -> None:
    rig, balls = fan(3, 20.0), (Ball(),)
    many = estimate(rig, balls)
    cores = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(cores)})
        one = estimate(rig, balls)
    finally:
        os.sched_setaffinity(0, cores)
    for a, b in zip(many, one, strict=True):
        assert a.depth_mm.tobytes() == b.depth_mm.tobytes()
        assert a.deviation_mm.tobytes() == b.deviation_mm.tobytes()


PIXEL_MM, MOST_PX = 2.0, 30


def level() -> tuple[np.ndarray, np.ndarray]:
    return np.full((40, 50), 800.0, np.float32), np.zeros((40, 50, 2), np.float32)


def test_piece_at_the_edge_of_the_picture_or_at_an_outline_stays() -> None:
    (edge, slopes), (outline, _) = level(), level()
    edge[36:, 20:24] = 820.0
    outline[:, 30:], outline[10:14, 27:30] = 0.0, 780.0
    for depth in (edge, outline):
        before = depth.copy()
        assert not replace_specks(depth, slopes, PIXEL_MM, MOST_PX).any()
        assert (depth == before).all()


def test_pieces_beside_each_other_stay_where_together_they_are_large() -> None:
    depth, slopes = level()
    depth[10:15, 10:15], depth[10:15, 15:20] = 820.0, 840.0
    depth[25:29, 10:13], depth[25:29, 13:16] = 820.0, 840.0
    specks = replace_specks(depth, slopes, PIXEL_MM, MOST_PX)
    assert not specks[:20].any()
    assert specks[25:29, 10:16].all()
    assert specks.sum() == 24
    assert np.abs(depth[25:29, 10:16] - 800.0).max() < 1e-3

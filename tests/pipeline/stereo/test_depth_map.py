"""A depth map's points are where its camera sees them."""

import numpy as np

from pipeline.stereo.depth_map import DepthMap, points_world
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at


def test_points_project_to_their_pixels_at_their_depths() -> None:
    rng = np.random.default_rng(3)
    pose = look_at(np.array([300.0, -900.0, 250.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera = Camera("a", Intrinsics(31, 23, 400.0, 410.0, 14.2, 12.9), pose)
    deviation = np.where(rng.random((23, 31)) < 0.6, 0.2, np.inf).astype(np.float32)
    known = np.isfinite(deviation)
    depth = np.where(known, rng.uniform(900, 1100, known.shape), 0.0).astype(np.float32)
    grid = np.zeros((23, 31, 3), np.float32)
    maps = DepthMap(camera, depth, grid, deviation, known.astype(np.uint8), depth, grid.astype(np.uint8))
    points = points_world(maps)
    row, column = np.nonzero(known)
    np.testing.assert_allclose(camera.project(points), np.stack([column, row], axis=1), atol=1e-9)
    np.testing.assert_allclose(camera.camera_from_world.apply(points)[:, 2], depth[known], rtol=1e-9)

"""A depth map's points are where its camera sees them."""

import numpy as np

from pipeline.stereo.depth_map import DepthMap, placing, points_world
from pipeline.stereo.depth_map_kernels import normals_of_known
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
    maps = DepthMap(camera, depth, grid, deviation, known.astype(np.uint8))
    points = points_world(maps)
    row, column = np.nonzero(known)
    np.testing.assert_allclose(camera.project(points), np.stack([column, row], axis=1), atol=1e-9)
    np.testing.assert_allclose(camera.camera_from_world.apply(points)[:, 2], depth[known], rtol=1e-9)


def test_normals_of_a_plane_are_its_own_where_it_is_known() -> None:
    rng = np.random.default_rng(4)
    pose = look_at(np.array([300.0, -900.0, 250.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera = Camera("a", Intrinsics(31, 23, 400.0, 410.0, 14.2, 12.9), pose)
    normal, offset = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0]), -900.0  # in the camera's frame
    row, column = np.indices((23, 31))
    rays = np.stack([(column - 14.2) / 400.0, (row - 12.9) / 410.0, np.ones((23, 31))], axis=2)
    depth = offset / (rays @ normal)
    slopes = np.stack([-(depth**2) / offset * normal[k] / (400.0, 410.0)[k] for k in range(2)], axis=2)
    known = rng.random((23, 31)) < 0.6
    found = normals_of_known(depth.astype(np.float32), slopes.astype(np.float32), known, *placing(camera)[:2])
    expected = camera.camera_from_world.rotation.T @ normal
    np.testing.assert_allclose(found[known], np.tile(expected, (known.sum(), 1)), atol=1e-5)
    assert not found[~known].any()

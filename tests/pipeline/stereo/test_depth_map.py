"""A depth map's points are where its camera sees them, without specks."""

import numpy as np
import pytest

from pipeline.stereo.depth_map import DepthMap, placing, points_world
from pipeline.stereo.depth_map_kernels import fill_specks, mark_specks, normals_of_known
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


HEIGHT, WIDTH = 40, 50
GAP_MM, MOST_PX = 1.0, 30


def slanted() -> tuple[np.ndarray, np.ndarray]:
    """A plane and its slopes, steeper than the gap between neighbours that are of one piece."""
    row, column = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    slopes = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    slopes[:] = (1.5, -0.4)
    return 800.0 + 1.5 * column - 0.4 * row, slopes


def found(depth: np.ndarray, slopes: np.ndarray, most_px: int = MOST_PX) -> np.ndarray:
    specks = np.ones(depth.shape, bool)
    mark_specks(depth, slopes, GAP_MM, most_px, specks)
    return specks


def test_speck_is_marked_and_laid_onto_what_is_about_it() -> None:
    depth, slopes = slanted()
    true = depth.copy()
    piece = np.zeros(depth.shape, bool)
    piece[10:15, 20:25] = True
    slopes[piece] = (-2.0, 1.0)
    depth[piece] = 860.0 + (np.mgrid[:5, :5] * np.array([1.0, -2.0])[:, None, None]).sum(axis=0).ravel()
    specks = found(depth, slopes)
    assert (specks == piece).all()
    fill_specks(depth, slopes, specks, 60)
    assert np.abs(depth - true).max() < 0.01  # a plane is the membrane through its own rim
    assert np.abs(slopes[piece] - (1.5, -0.4)).max() < 0.01


@pytest.mark.parametrize(("rows", "columns"), [(6, 6), (2, 40)])
def test_larger_piece_stays(rows: int, columns: int) -> None:
    depth, slopes = slanted()
    depth[10 : 10 + rows, 5 : 5 + columns] += 12.0
    assert not found(depth, slopes).any()


def test_ridge_that_hangs_together_with_the_surface_stays() -> None:
    depth, slopes = slanted()
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    depth += 6.0 * np.exp(-((row - 20.0) ** 2 + (column - 25.0) ** 2) / 18.0).astype(np.float32)  # 1.2 mm a pixel
    assert not found(depth, slopes).any()


def test_nothing_is_said_where_there_is_no_surface() -> None:
    depth, slopes = slanted()
    depth[:, 30:] = 0.0
    depth[20:23, 40:43] = 800.0  # alone: nothing to lay it onto
    specks = found(depth, slopes)
    assert specks.sum() == 9
    before = depth.copy()
    fill_specks(depth, slopes, specks, 10)
    assert (depth == before).all()


def test_speck_at_the_rim_is_filled_from_the_sides_that_it_has() -> None:
    depth, slopes = slanted()
    true = depth.copy()
    depth[:3, :4] -= 20.0
    specks = found(depth, slopes)
    assert specks.sum() == 12
    fill_specks(depth, slopes, specks, 60)
    assert np.abs(depth - true).max() < 6.0  # level where nothing lies beyond
    assert np.isfinite(slopes).all()

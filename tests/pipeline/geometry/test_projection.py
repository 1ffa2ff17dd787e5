"""One projection three times over: numpy's (``rig.camera``), the compiled loops', and OpenCV's."""

import cv2
import numpy as np
import pytest

from pipeline.geometry.projection import packed_camera, packed_lens, project_points
from pipeline.geometry.projection_kernels import LENS, NOWHERE, distorted, pinhole, placed, project, projection_slopes
from rig.camera import Distortion
from rig.geometry import vector_from_rotation
from rig.jit import njit
from tests.rig.test_camera import LENSES, POSE, camera

POINTS = np.random.default_rng(0).uniform(-150.0, 150.0, (200, 3))


@njit(cache=False)
def _pixels(points, row):
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        out[n] = project(row, points[n, 0], points[n, 1], points[n, 2])
    return out


@njit(cache=False, fastmath=True, error_model="numpy")
def _pixels_fast(points, row):
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        out[n] = project(row, points[n, 0], points[n, 1], points[n, 2])
    return out


@njit(cache=False)
def _slopes(points, row):
    out = np.empty((len(points), 2, 3))
    for n in range(len(points)):
        out[n, 0], out[n, 1] = projection_slopes(row, points[n, 0], points[n, 1], points[n, 2])
    return out


@njit(cache=False)
def _pinhole_pixels(points, row):
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        x, y, z = placed(row, points[n, 0], points[n, 1], points[n, 2])
        out[n] = pinhole(x / z, y / z, row[LENS:])
    return out


@pytest.mark.parametrize("lens", LENSES)
def test_numpy_compiled_loops_and_opencv_see_a_point_at_one_pixel(lens: Distortion) -> None:
    ours = camera(lens)
    expected, _ = cv2.projectPoints(
        POINTS, vector_from_rotation(POSE.rotation), POSE.translation, ours.intrinsics.matrix(), lens.opencv()
    )
    # Rounding of a double at 1,000 px is 1e-13; OpenCV's own turn through a rotation vector adds some 1e-10.
    np.testing.assert_allclose(ours.project(POINTS), expected[:, 0], atol=1e-8)
    np.testing.assert_allclose(_pixels(POINTS, packed_camera(ours)), ours.project(POINTS), atol=1e-11)
    np.testing.assert_allclose(_pixels_fast(POINTS, packed_camera(ours)), ours.project(POINTS), atol=1e-11)
    if lens.is_zero:
        np.testing.assert_allclose(_pinhole_pixels(POINTS, packed_camera(ours)), ours.project(POINTS), atol=1e-11)


@pytest.mark.parametrize("lens", LENSES)
def test_compiled_slopes_are_numpy_s(lens: Distortion) -> None:
    ours = camera(lens)
    _, expected = ours.project_with_jacobian(POINTS)
    np.testing.assert_allclose(_slopes(POINTS, packed_camera(ours)), expected, atol=1e-13)


def test_what_no_image_holds_is_nowhere() -> None:
    barrel = Distortion(k1=-0.3)
    ours, radius = camera(barrel), barrel.max_valid_radius()
    local = np.array([[0.0, 0.0, -500.0], [0.99 * radius, 0.0, 1.0], [1.01 * radius, 0.0, 1.0]]) * 100.0
    points = POSE.inverse().apply(local)
    gone = np.isnan(ours.project(points)).any(axis=1)
    np.testing.assert_array_equal(gone, [True, False, True])
    np.testing.assert_array_equal((_pixels(points, packed_camera(ours)) == NOWHERE).all(axis=1), gone)
    assert distorted(1.01 * radius, 0.0, packed_lens(ours)) == (NOWHERE, NOWHERE)


@pytest.mark.parametrize("lens", LENSES)
def test_many_points_are_projected_as_by_the_camera(lens: Distortion) -> None:
    behind = POSE.inverse().apply(np.array([[10.0, 5.0, -300.0]]))
    beside = POSE.inverse().apply(np.array([[900.0, 0.0, 300.0]]))  # past the turning radius of a lens that has one
    points = np.concatenate([POINTS, behind, beside])
    expected = camera(lens).project(points)
    assert np.isnan(expected[-2]).all()
    np.testing.assert_allclose(project_points(camera(lens), points), expected, atol=1e-9)

"""The camera against OpenCV's projection, finite differences, and itself turned round."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import RigidTransform, look_at, rotation_from_vector, vector_from_rotation

LENSES = [
    Distortion(),
    Distortion(k1=-0.15),
    Distortion(-0.21, 0.09, 1.2e-3, -8e-4, -0.02),
    Distortion(0.08, -0.04, -5e-4, 1e-3, 0.01),
]
POSE = look_at(np.array([400.0, 150.0, 1000.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
POINTS = np.random.default_rng(0).uniform(-150.0, 150.0, (40, 3))


def camera(lens: Distortion, pose: RigidTransform = POSE) -> Camera:
    return Camera("cam", Intrinsics(1024, 768, 1480.0, 1510.0, 530.3, 371.8, lens), pose)


@pytest.mark.parametrize("lens", LENSES)
def test_projection_is_opencv_s(lens: Distortion) -> None:
    ours = camera(lens)
    expected, _ = cv2.projectPoints(
        POINTS, vector_from_rotation(POSE.rotation), POSE.translation, ours.intrinsics.matrix(), lens.opencv()
    )
    np.testing.assert_allclose(ours.project(POINTS), expected[:, 0], atol=1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_undistortion_is_opencv_s(lens: Distortion) -> None:
    ours = camera(lens)
    pixels = ours.project(POINTS)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    expected = cv2.undistortPoints(pixels[:, None], ours.intrinsics.matrix(), lens.opencv(), None, None, None, stop)
    np.testing.assert_allclose(ours.undistort(pixels), expected[:, 0], atol=1e-7)


@pytest.mark.parametrize("lens", LENSES)
def test_jacobian_by_finite_differences(lens: Distortion) -> None:
    ours, step = camera(lens), 1e-3
    pixels, jacobian = ours.project_with_jacobian(POINTS)
    np.testing.assert_allclose(pixels, ours.project(POINTS))
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (ours.project(POINTS + shift) - ours.project(POINTS - shift)) / (2 * step)
        # error of a central difference: step^2 f''' / 6, far below, and rounding, 1e-13 * 1000 px / 1e-3 mm
        np.testing.assert_allclose(jacobian[:, :, axis], slope, atol=1e-6)


@settings(max_examples=60)
@given(
    lens=st.sampled_from(LENSES), u=st.floats(-0.5, 1023.5), v=st.floats(-0.5, 767.5), depth=st.floats(100.0, 5000.0)
)
def test_a_point_on_a_pixel_s_ray_projects_to_that_pixel(lens: Distortion, u: float, v: float, depth: float) -> None:
    ours, pixel = camera(lens), np.array([[u, v]])
    ray = ours.rays_world(pixel)
    assert np.linalg.norm(ray) == pytest.approx(1.0)
    np.testing.assert_allclose(ours.project(ours.centre_world + depth * ray), pixel, atol=1e-6)


def test_points_and_pixels_beyond_the_valid_radius_are_nan() -> None:
    barrel = Distortion(k1=-0.3)
    ours = camera(barrel)
    radius = barrel.max_valid_radius()
    assert radius == pytest.approx(np.sqrt(1 / 0.9))  # 1 + 3 k1 r^2 = 0
    local = np.array([[0.0, 0.0, -500.0], [0.99 * radius, 0.0, 1.0], [1.01 * radius, 0.0, 1.0]])
    pixels = ours.project(POSE.inverse().apply(local))
    np.testing.assert_array_equal(np.isnan(pixels).all(axis=1), [True, False, True])
    farthest = barrel.apply(np.array([[radius, 0.0]]))
    assert np.isnan(barrel.remove(1.01 * farthest)).all()
    assert np.isfinite(barrel.remove(0.98 * farthest)).all()
    assert Distortion().max_valid_radius() == np.inf
    assert Distortion(k1=0.2).max_valid_radius() == np.inf
    lens = LENSES[2]
    r = np.linspace(0, lens.max_valid_radius() * 0.9999, 500)
    grown = r * (1 + lens.k1 * r**2 + lens.k2 * r**4 + lens.k3 * r**6)
    assert (np.diff(grown) > 0).all()


@pytest.mark.parametrize("factor", [0.5, 0.25, 2.0])
@pytest.mark.parametrize("lens", LENSES)
def test_a_scaled_camera_sees_the_same_scene(factor: float, lens: Distortion) -> None:
    ours = camera(lens)
    scaled = replace(ours, intrinsics=ours.intrinsics.scaled(factor))
    assert (scaled.intrinsics.width, scaled.intrinsics.height) == (1024 * factor, 768 * factor)
    # The image's corner, (-1/2, -1/2), stays the corner: u' + 1/2 = factor (u + 1/2).
    np.testing.assert_allclose(scaled.project(POINTS) + 0.5, factor * (ours.project(POINTS) + 0.5), atol=1e-9)


@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3).map(np.array), shift=st.tuples(*[st.floats(-500, 500)] * 3).map(np.array)
)
def test_moving_world_and_camera_together_changes_no_pixel(turn: np.ndarray, shift: np.ndarray) -> None:
    world_from_other = RigidTransform(rotation_from_vector(turn), shift)
    moved = camera(LENSES[2], POSE @ world_from_other)
    points = world_from_other.inverse().apply(POINTS)
    np.testing.assert_allclose(moved.project(points), camera(LENSES[2]).project(POINTS), atol=1e-7)

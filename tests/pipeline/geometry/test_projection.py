"""One projection twice over: numpy's (``rig.camera``, tested beside OpenCV's) and the compiled loops';
depths beside closed forms."""

import numpy as np
import pytest

from pipeline.geometry.projection import camera_depths, depth_map, packed_camera, packed_lens, project_points
from pipeline.geometry.projection_kernels import (
    LENS,
    NOWHERE,
    distorted,
    interpolate,
    pinhole,
    placed,
    project,
    projection_slopes,
    rasterise,
)
from rig.camera import Distortion
from rig.jit import njit
from rig.mesh import face_normals
from tests.rig.test_camera import LENSES, POSE, camera
from tests.support.scenes import ellipsoid, fan, pixel_grid, ray_ellipsoid

POINTS = np.random.default_rng(0).uniform(-150.0, 150.0, (200, 3))


def _pixels_of(points, row):
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        out[n] = project(row, points[n, 0], points[n, 1], points[n, 2])
    return out


_pixels = njit(cache=False)(_pixels_of)
_pixels_fast = njit(cache=False, fastmath=True, error_model="numpy")(_pixels_of)


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
def test_numpy_and_compiled_loops_see_a_point_at_one_pixel(lens: Distortion) -> None:
    ours = camera(lens)
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


def test_depth_agrees_with_the_closed_form_of_an_ellipsoid() -> None:
    # Flat triangles of edge e = 4 mm on a radius r >= 59 mm sink below the ellipsoid by at most e^2 / (6 r) = 0.05 mm
    # along the normal; where the ray meets the surface at 60 degrees or less that is twice as much along the ray.
    mesh, camera = ellipsoid(), fan().cameras[1]
    depth, seen = depth_map(camera, mesh.vertices, mesh.faces)
    truth = ray_ellipsoid(camera, pixel_grid(camera)).reshape(depth.shape)
    both = np.isfinite(depth) & np.isfinite(truth)
    assert np.count_nonzero(np.isfinite(depth) != np.isfinite(truth)) < 0.1 * np.sqrt(both.sum()) * 2 * np.pi
    normals = face_normals(mesh.vertices, mesh.faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frontal = both & (np.abs(normals[seen] @ camera.axis_world) > 0.5)
    assert frontal.sum() > 0.6 * both.sum()
    assert np.abs(depth[frontal] - truth[frontal]).max() < 0.12


def test_the_nearer_of_two_triangles_is_seen_whatever_their_order() -> None:
    pixels = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]] * 2)
    depths = np.array([100.0] * 3 + [90.0] * 3)
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 4, 5], [0, 1, 2]]):
        depth, seen = rasterise(pixels, depths, np.array(faces, np.int32), 10, 10)
        assert depth[2, 2] == 90.0
        assert faces[seen[2, 2]] == [3, 4, 5]
        assert seen[9, 9] == -1
        assert np.isinf(depth[9, 9])


def test_triangles_behind_the_camera_or_without_a_pixel_leave_no_mark() -> None:
    pixels = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0], [np.nan, np.nan]])
    faces = np.array([[0, 1, 2], [0, 1, 3]], np.int32)
    _, seen = rasterise(pixels, np.array([100.0, -5.0, 100.0, 100.0]), faces, 10, 10)
    assert (seen == -1).all()


def test_values_are_interpolated_with_perspective() -> None:
    # Camera x and y of the surface are linear on a triangle in space: drawn, they must give back the pixel's own ray.
    mesh, camera = ellipsoid(3), fan().cameras[0]
    pixels, depths = camera.project(mesh.vertices), camera_depths(camera, mesh.vertices)
    depth, seen = rasterise(pixels, depths, mesh.faces, camera.intrinsics.height, camera.intrinsics.width)
    drawn = interpolate(seen, pixels, depths, mesh.faces, mesh.vertices)
    where = seen >= 0
    expected = camera.project(drawn[where].astype(float))
    wanted = np.argwhere(where)[:, ::-1]
    # 16 mm edges bend by the lens over 11 px: k1 * (edge / f)^2 stays far below 0.02 px.
    assert np.abs(expected - wanted).max() < 0.02
    assert np.abs(camera_depths(camera, drawn[where].astype(float)) - depth[where]).max() < 0.01

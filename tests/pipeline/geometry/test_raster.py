import numpy as np

from pipeline.geometry.projection import camera_depths, depth_map
from pipeline.geometry.projection_kernels import interpolate, rasterise
from rig.mesh import face_normals
from tests.support.scenes import ellipsoid, fan, pixel_grid, ray_ellipsoid


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

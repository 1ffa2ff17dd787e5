"""The rim against closed forms: a sphere's outline is a known circle of directions."""

from functools import cache

import numpy as np
import pytest
import trimesh

from pipeline.contour_fit.rim import find_rim, make_topology, pack_views
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import look_at
from rig.rig import Rig

RADIUS, RANGE = 90.0, 1200.0
LENS = Distortion(k1=-0.08, k2=0.02, p1=4e-4, p2=-3e-4)


@cache
def rig(distortion: Distortion = LENS) -> Rig:
    eyes = RANGE * np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.36, 0.48, 0.8]])
    intrinsics = Intrinsics(640, 480, 1500.0, 1503.0, 322.0, 236.0, distortion)
    views = [look_at(eye, np.array([5.0, -3.0, 0.0]), np.array([0.0, 1.0, 0.0])) for eye in eyes]
    return Rig(tuple(Camera(f"cam{i:02}", intrinsics, view) for i, view in enumerate(views)))


def sphere(
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0), radius: float = RADIUS
) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(5, radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces, np.int32)


@cache
def outline_distance(camera: Camera, radius: float = RADIUS) -> np.ndarray:
    """Signed distance (px) to a sphere's outline about the world origin: the ray's distance from the centre, to first
    order in pixels, which near the outline is exact to 1e-3 px."""
    k = camera.intrinsics
    pixels = np.stack(np.meshgrid(np.arange(k.width), np.arange(k.height)), axis=-1).reshape(-1, 2).astype(float)
    rays, eye = camera.rays_world(pixels), camera.centre_world
    angle = np.arccos(np.clip(rays @ (-eye / np.linalg.norm(eye)), -1.0, 1.0)) - np.arcsin(radius / np.linalg.norm(eye))
    image = angle.reshape(k.height, k.width)
    gy, gx = np.gradient(image)
    distance = (image / np.hypot(gx, gy)).astype(np.float32)
    distance.flags.writeable = False
    return distance


def rim_of(vertices: np.ndarray, faces: np.ndarray, distances: dict[str, np.ndarray], cameras: Rig):
    topology = make_topology(faces, np.ones(len(vertices), bool))
    return find_rim(topology, vertices, pack_views(cameras, distances))


def test_sphere_rim_lies_on_its_outline_under_distortion():
    cameras = rig()
    found = rim_of(*sphere(), {c.name: outline_distance(c) for c in cameras}, cameras)
    for k in range(3):
        here = found.view == k
        assert here.sum() > 50
        # Chords of 4.7 mm sag by 0.03 mm = 0.04 px; the lift by the sagitta must take that to a tenth.
        assert np.abs(found.residual[here]).max() < 0.01
        # The whole circle speaks: radius f R / sqrt(d^2 - R^2), to 2 % for lens and polygon.
        circle = 2 * np.pi * 1500.0 * RADIUS / np.sqrt(RANGE**2 - RADIUS**2)
        assert found.length[here].sum() == pytest.approx(circle, rel=0.02)


def test_averaged_residuals_stay_on_the_outline_and_hold_more_of_a_noisy_contour():
    """White noise of pixels, read bilinearly, has an integral of 2/3 px along a line (across it, the mean of
    f^2 + (1 - f)^2): the mean over a length of it varies by sigma sqrt(2/3 / length), and by more where it is read at
    samples alone."""
    cameras, (vertices, faces) = rig(), sphere()
    clean, rng = {c.name: outline_distance(c) for c in cameras}, np.random.default_rng(4)
    topology = make_topology(faces, np.ones(len(vertices), bool))
    exact = find_rim(topology, vertices, pack_views(cameras, clean), averaged=True)
    assert np.abs(exact.residual).max() < 0.012  # the arc between samples, not its chord
    lengths, deviations = [], []
    for averaged in (False, True):
        means = []
        for _ in range(12):
            noisy = {n: d + 0.3 * rng.standard_normal(d.shape).astype(np.float32) for n, d in clean.items()}
            found = find_rim(topology, vertices, pack_views(cameras, noisy), averaged=averaged)
            for k in range(3):
                here = found.view == k
                pieces = np.arange(here.sum()) // 10
                total = np.bincount(pieces, found.length[here])
                means.append((np.bincount(pieces, (found.length * found.residual)[here]) / total)[:-1])  # full ones
                lengths.append(total[:-1])
        deviations.append(np.concatenate(means).std())
    assert deviations[1] == pytest.approx(0.3 * np.sqrt((2.0 / 3.0 / np.concatenate(lengths)).mean()), rel=0.1)
    assert deviations[0] > 1.2 * deviations[1]


def test_gradient_predicts_how_the_residual_grows_with_the_sphere():
    cameras = rig()
    distances = {c.name: outline_distance(c) for c in cameras}
    before, after = (rim_of(*sphere(radius=RADIUS + step), distances, cameras) for step in (0.0, 0.5))
    for k in range(3):
        grown = after.residual[after.view == k].mean() - before.residual[before.view == k].mean()
        here = before.view == k
        outward = before.point[here] / np.linalg.norm(before.point[here], axis=1, keepdims=True)
        predicted = 0.5 * (before.gradient[here] * outward).sum(axis=1).mean()
        assert grown == pytest.approx(predicted, rel=0.01)


def test_normals_stand_on_the_outline_of_a_rolled_camera_with_oblong_pixels():
    intrinsics = Intrinsics(640, 480, 1500.0, 1100.0, 322.0, 236.0, LENS)
    eye, up = RANGE * np.array([0.6, 0.0, 0.8]), np.array([0.8, 0.5, 0.1])
    camera = Camera("rolled", intrinsics, look_at(eye, np.zeros(3), up))
    distance = outline_distance(camera)
    found = rim_of(*sphere(), {"rolled": distance}, Rig((camera,)))
    gy, gx = np.gradient(distance)
    column, row = np.rint(found.pixel).astype(int).T
    outward = np.stack([gx[row, column], gy[row, column]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    # Edges of 4.7 mm on a sphere of 90 mm stand off its normals by up to 1.5 degrees.
    assert (found.normal * outward).sum(axis=1).min() > np.cos(np.radians(1.5))


def test_a_rim_in_front_of_another_surface_is_silent():
    cameras = rig(Distortion())
    ball, faces = sphere()
    small, small_faces = sphere((0.0, 0.0, 150.0), 30.0)  # before the ball's middle, as the front camera sees it
    vertices, both = np.concatenate([ball, small]), np.concatenate([faces, small_faces + len(ball)])
    found = rim_of(vertices, both, {c.name: outline_distance(c) for c in cameras}, cameras)
    speaks = found.corner[found.view == 0].min(axis=1)
    assert len(speaks) > 50
    assert (speaks < len(ball)).all()


def test_what_is_seen_through_a_hole_is_covered_by_the_far_side():
    """Faces that look away cover as well: a hole towards the camera shows the inside, so its edge is no outline."""
    cameras = rig(Distortion())
    ball, faces = sphere()
    direction = ball / RADIUS @ np.array([0.1, 0.05, 1.0])
    open_faces = faces[~(direction[faces] > 0.93).any(axis=1)]
    found = rim_of(ball, open_faces, {c.name: outline_distance(c) for c in cameras}, cameras)
    assert np.abs(found.residual[found.view == 0]).max() < 0.1


def test_an_edge_of_three_faces_is_refused():
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], np.int32)
    with pytest.raises(ValueError, match="more than two faces"):
        make_topology(faces, np.ones(5, bool))

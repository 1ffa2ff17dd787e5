"""A face's points from its detections: biases taken off, noise as it is stated, and what a view's points share."""

import numpy as np

from pipeline.faces.detection import FaceDetection
from pipeline.faces.points import direction_from_face, point_table, view_bias
from pipeline.faces.triangulated_face import (
    SOME_POINTS,
    TriangulatedFace,
    point_noise_px,
    shared_modes,
    triangulate_face,
    unbiased_px,
    view_noise_px,
)
from rig.camera import Camera, Intrinsics
from rig.geometry import Similarity, look_at, rotation_from_vector
from rig.rig import Rig
from tests.support.drawn_faces import seen_face

FACE = Similarity(1.05, rotation_from_vector(np.array([0.1, -0.15, 0.4])), np.array([5.0, -10.0, 20.0]))
SHARE = 1 / 3


def camera(name: str, azimuth_deg: float, elevation_deg: float) -> Camera:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    away = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    pose = look_at(1100.0 * away, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return Camera(name, Intrinsics(1024, 768, 1500.0, 1500.0, 520.0, 377.0), pose)


RIG = Rig(tuple(camera(f"cam{k}", *d) for k, d in enumerate(((0, 0), (-35, 10), (35, 10), (-60, 0), (60, 0), (0, 30)))))


def seen(noise_px: float, seed: int = 0) -> dict[str, FaceDetection]:
    rng = np.random.default_rng(seed)
    return {camera.name: seen_face(FACE, camera, rng, noise_px=noise_px) for camera in RIG}


def triangulated(detections: dict[str, FaceDetection]) -> TriangulatedFace:
    found = triangulate_face(detections, RIG)
    assert found is not None
    return found


def test_without_noise_the_points_come_back_without_their_bias() -> None:
    found = triangulated(seen(0.0))
    true = FACE.apply(point_table().shape_mm)
    # The bias goes by the direction from which a camera looks, and that by the points: two rounds leave a tenth of what
    # a point errs by anyhow.
    assert np.linalg.norm(found.points.positions_world - true, axis=1).max() < 0.3
    assert abs(found.relief - 1.0) < 1e-3
    assert max(found.misfits.values()) < 0.05


def test_the_bias_is_turned_with_the_face() -> None:
    each = RIG["cam1"]
    face = seen_face(FACE, each, np.random.default_rng(0), noise_px=0.0)
    bias = face.size_px * view_bias(direction_from_face(FACE, each))
    taken_off = face.landmarks_px - unbiased_px(face, FACE, each)
    np.testing.assert_allclose(np.linalg.norm(taken_off, axis=1), np.linalg.norm(bias, axis=1))
    right, up = np.deg2rad(face.roll_deg), np.deg2rad(face.roll_deg - 90.0)
    np.testing.assert_allclose(taken_off @ (np.cos(right), np.sin(right)), bias[:, 0], atol=1e-9)
    np.testing.assert_allclose(taken_off @ (np.cos(up), np.sin(up)), -bias[:, 1], atol=1e-9)


def test_covariances_hold_for_the_noise_they_state() -> None:
    """With a third of the noise that is expected (all of it would make the faces larger, and so the noise), errors are
    a third of what the covariances say."""
    rng, clean = np.random.default_rng(7), triangulated(seen(0.0))
    noisy = {}
    for (name, face), noise in zip(clean.detections.items(), clean.noise_px, strict=True):
        points = face.landmarks_px + SHARE * noise[:, None] * rng.standard_normal((468, 2))
        noisy[name] = FaceDetection(points, face.score, face.box_px, face.roll_deg)
    found = triangulated(noisy)
    miss = found.points.positions_world - clean.points.positions_world
    squares = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(found.points.covariances), miss)
    # Chi-square with three degrees of freedom, 468 times: 3 +- 0.11 in units of that noise.
    assert abs(squares.mean() / SHARE**2 - 3.0) < 0.4


def test_a_view_that_is_off_moves_all_points_as_its_modes_say() -> None:
    """One standard deviation of one view's noise along an axis: the points move as the mode does, but for what the
    weights and the bias change."""
    clean = triangulated(seen(0.0))
    modes = shared_modes(clean, RIG)
    assert modes.shape == (2 * len(RIG), 468, 3)
    for view, name in enumerate(RIG.names[:3]):
        for axis in range(2):
            moved = dict(clean.detections)
            face = moved[name]
            shift = np.eye(2)[axis] * clean.view_noise_px[view]
            moved[name] = FaceDetection(face.landmarks_px + shift, face.score, face.box_px, face.roll_deg)
            step = triangulated(moved).points.positions_world - clean.points.positions_world
            mode = modes[2 * view + axis]
            assert np.linalg.norm(step - mode, axis=1).mean() < 0.2 * np.linalg.norm(mode, axis=1).mean()


def test_noise_grows_with_the_angle() -> None:
    points = FACE.apply(point_table().shape_mm)
    front, side = point_noise_px(300.0, points, FACE, RIG["cam0"]), point_noise_px(300.0, points, FACE, RIG["cam3"])
    assert np.median(side) > 1.2 * np.median(front)
    np.testing.assert_allclose(point_noise_px(600.0, points, FACE, RIG["cam0"]), 2.0 * front)
    few = point_noise_px(300.0, points[SOME_POINTS], FACE, RIG["cam0"], SOME_POINTS)
    np.testing.assert_allclose(few, front[SOME_POINTS])
    assert view_noise_px(300.0, FACE, RIG["cam3"]) > 1.5 * view_noise_px(300.0, FACE, RIG["cam0"])


def test_one_view_determines_nothing_and_results_are_the_same_byte_for_byte() -> None:
    assert triangulate_face({"cam0": seen(0.0)["cam0"]}, RIG) is None
    first, second = triangulated(seen(1.0)), triangulated(seen(1.0))
    assert first.points.positions_world.tobytes() == second.points.positions_world.tobytes()

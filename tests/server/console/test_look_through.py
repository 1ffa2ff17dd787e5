"""A head seen through a camera of the rig lies where the camera projects it, and photographs lose their lens."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.results.report_types import Report
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import RigidTransform, rotation_from_vector
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from server.console.media import camera_views, straighten, straighten_face

LENS = Distortion(-0.14, 0.04, 0.001, -0.0008, 0.0)


def camera(distortion: Distortion, width: int = 640) -> Camera:
    factor = width / 640
    lens = Intrinsics(
        width, round(480 * factor), 800.0 * factor, 805.0 * factor, 318.0 * factor, 241.0 * factor, distortion
    )
    return Camera(
        "cam00", lens, RigidTransform(rotation_from_vector(np.array([0.1, 0.4, -0.05])), np.array([9.0, -7.0, 1100.0]))
    )


def test_points_of_the_head_lie_where_the_camera_projects_them() -> None:
    scale, rotation, shift = 1.07, rotation_from_vector(np.array([0.02, -0.3, 0.1])), np.array([12.0, 33.0, -8.0])
    place = {"scale": scale, "rotation": rotation.tolist(), "translation": (shift / scale).tolist()}
    pinhole = camera(Distortion())
    (view,) = camera_views(Rig((pinhole,)), Report(world_from_head=place))  # type: ignore[typeddict-item]
    in_glb_m = np.random.default_rng(2).uniform(-0.09, 0.09, (20, 3))
    world = RigidTransform(rotation, shift).apply(in_glb_m * 1000.0)  # head.glb undoes the pose, not the scale
    seen = np.c_[in_glb_m, np.ones(20)] @ np.array(view["camera_from_head"]).T
    pixels = seen[:, :2] / seen[:, 2:3] * [view["fx"], view["fy"]] + [view["cx"], view["cy"]]
    np.testing.assert_allclose(pixels, pinhole.project(world), atol=1e-6)


@pytest.mark.parametrize("width", [640, 3200])
def test_a_straightened_photograph_shows_points_where_a_pinhole_does(width: int) -> None:
    lens, pinhole = camera(LENS, width), camera(Distortion(), width)
    points = np.array([[-150.0, -90.0, 0.0], [140.0, 100.0, 20.0], [0.0, 0.0, 0.0]])
    photograph = np.zeros((lens.intrinsics.height, width, 3), np.uint8)
    radius = 4 * width // 640
    for x, y in lens.project(points):
        cv2.circle(photograph, (round(x * 16), round(y * 16)), radius * 16, (255, 255, 255), -1, cv2.LINE_AA, shift=4)
    shown = straighten(photograph, lens)
    factor = shown.shape[1] / width
    assert shown.shape[1] == min(width, 1600)
    for x, y in factor * (pinhole.project(points) + 0.5) - 0.5:
        left, top, reach = round(x) - 3 * radius, round(y) - 3 * radius, 6 * radius + 1
        patch = shown[top : top + reach, left : left + reach, 0].astype(float)
        rows, columns = np.mgrid[:reach, :reach]
        found = np.array([left + (patch * columns).sum() / patch.sum(), top + (patch * rows).sum() / patch.sum()])
        # the disc's centroid: interpolation and anti-aliasing leave a few hundredths of a pixel, the bent disc a tenth
        np.testing.assert_allclose(found, [x, y], atol=0.15)


@pytest.mark.parametrize("recorded", [False, True])
def test_a_face_lies_on_the_straightened_photograph(recorded: bool) -> None:
    points = np.array([[-150.0, -90.0, 0.0], [140.0, 100.0, 20.0], [0.0, 0.0, 0.0]])
    pinhole = camera(Distortion())
    wanted = pinhole.project(points)
    lens = camera(Distortion() if recorded else LENS)
    pixels = lens.project(points)
    if recorded:
        fisheye = RecordedLens("kannala-brandt", (0.05, 0.01, 0.0, 0.0))
        lens = replace(lens, recorded=fisheye)
        pixels = fisheye.distorted(wanted, lens.intrinsics.matrix())
    face = {
        "box_px": [0.0, 0.0, 1.0, 1.0],
        "roll_deg": 3.0,
        "score": 20.0,
        "is_subject": True,
        "points": pixels.tolist(),
    }
    straight = straighten_face(face, lens)
    np.testing.assert_allclose(straight["points"], wanted, atol=0.06)
    np.testing.assert_allclose(straight["box_px"], [*wanted.min(axis=0), *wanted.max(axis=0)], atol=0.06)
    assert straight["is_subject"]
    beyond = {**face, "points": [[1e6, 1e6]]}
    assert straighten_face(beyond, camera(LENS))["points"] == [], "no ray of the lens goes there"

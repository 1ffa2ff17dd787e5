"""A known length beside cameras of any unit: points, tags and cameras make it millimetres; a rig that agrees stays."""

import cv2
import numpy as np
import pytest

from calibration.scene.scale import scaled_by_length, times
from rig.camera import Camera
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.scale_json import CameraDistance, PointDistance, TagSize
from rig.plausibility import rig_faults
from rig.studio.scene.layout import default_layout

RIG = default_layout()
BLANK = Capture({name: np.zeros((8, 8, 3), np.uint8) for name in RIG.names})
ENDS = np.array([[-31.0, 20.0, 80.0], [31.0, 22.0, 79.0]])
DISTANCE = float(np.linalg.norm(ENDS[1] - ENDS[0]))


def points() -> PointDistance:
    first, second = ({camera.name: camera.project(end[None])[0] for camera in RIG.cameras[:4]} for end in ENDS)
    return PointDistance(first, second, DISTANCE)


def cameras() -> CameraDistance:
    one, two = RIG.cameras[0], RIG.cameras[3]
    return CameraDistance((one.name, two.name), float(np.linalg.norm(one.centre_world - two.centre_world)))


def tagged(camera: Camera, side_mm: float) -> np.ndarray:
    """A tag before the camera, seen through its lens."""
    flat = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 3, 240)
    flat = np.pad(flat, 60, constant_values=255)
    corners = 0.5 * side_mm * 1.5 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) + (0, 0, 60)
    pixels = camera.project(corners).astype(np.float32)
    source = np.array([[-0.5, -0.5], [359.5, -0.5], [359.5, 359.5], [-0.5, 359.5]], np.float32)
    way = cv2.getPerspectiveTransform(source, pixels)
    seen = cv2.warpPerspective(flat, way, (camera.intrinsics.width, camera.intrinsics.height), flags=cv2.INTER_AREA,
                               borderValue=128)  # fmt: skip
    return cv2.merge([cv2.GaussianBlur(seen, (0, 0), 0.7)] * 3)


@pytest.mark.parametrize("factor", [0.01, 0.3, 3.3])
@pytest.mark.parametrize("known", [points(), cameras()], ids=["points", "cameras"])
def test_the_length_makes_the_rig_millimetres(factor: float, known: PointDistance | CameraDistance) -> None:
    free = times(RIG, factor)
    assert factor != 0.01 or rig_faults(free)
    assert not rig_faults(free, any_unit=True)
    scaled, (remark,) = scaled_by_length(BLANK, free, free, known)
    assert remark.code == "cameras-scaled"
    for camera, true in zip(scaled, RIG, strict=True):
        np.testing.assert_allclose(camera.centre_world, true.centre_world, rtol=1e-3, atol=1e-3)
    assert not rig_faults(scaled)


def test_a_printed_tag_does() -> None:
    free = times(RIG, 2.0)
    views = Capture({camera.name: tagged(camera, 40.0) for camera in RIG.cameras[:4]})
    scaled, remarks = scaled_by_length(views, free, free, TagSize("DICT_4X4_50", 40.0))
    assert len(remarks) == 1
    ratio = np.linalg.norm(scaled.cameras[0].centre_world) / np.linalg.norm(RIG.cameras[0].centre_world)
    assert ratio == pytest.approx(1.0, abs=0.01)
    with pytest.raises(InputError, match="no tag of it was found"):
        scaled_by_length(views, free, free, TagSize("DICT_5X5_50", 40.0))


def test_cameras_that_agree_with_the_length_stay_and_covariances_grow_with_the_rig() -> None:
    near = times(RIG, 1.001)
    same, remarks = scaled_by_length(BLANK, near, near, cameras())
    assert (same.cameras, remarks) == (near.cameras, [])
    camera = RIG.cameras[0]
    before = np.diag([1e-6, 1e-6, 1e-6, 0.1, 0.1, 0.1])
    (after,) = times(type(RIG)((Camera(camera.name, camera.intrinsics, camera.camera_from_world, before),)), 2.0)
    assert after.covariance is not None
    np.testing.assert_allclose(np.diag(after.covariance), [1e-6, 1e-6, 1e-6, 0.4, 0.4, 0.4])

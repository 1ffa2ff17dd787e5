"""Large pictures that are read smaller: the same places, whichever decoder did how much of it."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.pictures.images import write_image
from rig.formats.pictures.work_size import at_share, halvings, work_rig, work_share
from rig.geometry import RigidTransform
from rig.rig import Rig
from tests.support.services import small_capture

WIDTH, HEIGHT, RADIUS_PX = 640, 480, 60.0


def one_camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    lens = Intrinsics(width, height, 900.0, 905.0, (width - 1) / 2 + 7.3, (height - 1) / 2 - 4.1)
    return Camera("cam00", lens, RigidTransform(np.eye(3), np.array([0.0, 0.0, 1000.0])))


def disc(camera: Camera, centre_px: np.ndarray) -> np.ndarray:
    """A bright disc with an edge of a pixel, in grey."""
    k = camera.intrinsics
    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    inside = np.clip(RADIUS_PX + 0.5 - np.hypot(u - centre_px[0], v - centre_px[1]), 0, 1)
    return np.rint(20 + 200 * inside).astype(np.uint8)


def middle(picture: np.ndarray) -> np.ndarray:
    """The centroid of what is brighter than the background, px."""
    weight = picture[..., 0].astype(float) - 20
    weight[weight < 10] = 0
    v, u = np.indices(weight.shape)
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.mark.parametrize(("suffix", "share"), [("png", 0.5), ("png", 0.4), ("jpg", 0.5), ("jpg", 0.25), ("jpg", 0.3)])
def test_a_point_lies_where_the_smaller_camera_sees_it(tmp_path: Path, suffix: str, share: float) -> None:
    """A twentieth of a pixel: a half pixel's shift of one convention against another would be ten times that."""
    camera, point = one_camera(), np.array([[31.0, -24.0, 0.0]])
    places = [RigidTransform(np.eye(3), np.array([25.0 * i, 0.0, 1000.0])) for i in range(3)]
    rig = Rig(tuple(replace(camera, name=f"cam{i:02}", camera_from_world=at) for i, at in enumerate(places)))
    for name in rig.names:
        grey = disc(camera, rig[name].project(point)[0])
        write_image(tmp_path / "images" / f"{name}.{suffix}", np.dstack([grey] * 3), quality=98)
        write_image(tmp_path / "masks" / f"{name}.png", (grey > 120).astype(np.uint8))
    features = {"pronasale": {name: rig[name].project(point)[0].tolist() for name in rig.names}}
    write_capture(tmp_path, Capture({}), rig)
    (tmp_path / "features.json").write_text(json.dumps({"format": "eigenhead-features/1", "points": features}))
    capture, work = read_capture(tmp_path, pixels_most=round(share**2 * WIDTH * HEIGHT))
    k = work["cam00"].intrinsics
    assert (k.width, k.height) == (round(share * WIDTH), round(share * HEIGHT))
    assert capture.images["cam00"].shape == (k.height, k.width, 3)
    assert capture.masks["cam00"].shape == (k.height, k.width)
    there = work["cam00"].project(point)[0]
    assert middle(capture.images["cam00"]) == pytest.approx(there, abs=0.05)
    # Of whole pixels, 94 of them on the rim of the smallest disc: 0.06 px is one standard deviation of its centroid.
    assert np.argwhere(capture.masks["cam00"])[:, ::-1].mean(axis=0) == pytest.approx(there, abs=0.2)
    assert capture.features["pronasale"]["cam00"] == pytest.approx(there, abs=1e-9)


def test_small_pictures_and_those_of_no_limit_stay_as_they_are(tmp_path: Path) -> None:
    folder = small_capture(tmp_path)
    for most in (None, 24 * 24):
        capture, rig = read_capture(folder, pixels_most=most)
        assert capture.images["cam00"].shape == (24, 24, 3)
        assert rig["cam00"].intrinsics.width == 24


def test_a_picture_of_another_size_is_named_with_the_size_of_its_file(tmp_path: Path) -> None:
    folder = small_capture(tmp_path)
    write_image(folder / "images" / "cam01.png", np.zeros((25, 24, 3), np.uint8))
    with pytest.raises(InputError, match=r"images/cam01.png is 24 x 25 pixels, but its camera is 24 x 24"):
        read_capture(folder, pixels_most=100)


def test_shares_are_those_that_decoders_know_where_they_are_near() -> None:
    large = one_camera(6000, 4000).intrinsics
    assert work_share(large, 6_000_000) == 0.5
    assert work_share(large, 5_500_000) == 0.5
    assert work_share(large, 4_000_000) == pytest.approx((1 / 6) ** 0.5)
    assert work_share(large, None) == work_share(large, 24_000_000) == 1.0
    assert work_rig(Rig((one_camera(),)), None).cameras[0].intrinsics.width == WIDTH
    assert [halvings(share, (640, 480)) for share in (1.0, 0.5, 0.4, 0.25, 0.1)] == [0, 1, 1, 2, 3]
    assert halvings(0.25, (642, 480)) == 1
    assert halvings(0.25, (641, 480)) == 0
    fine = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    assert at_share(fine, (640, 480), 1.0) is fine
    half = at_share(cv2.resize(fine, (320, 240), interpolation=cv2.INTER_AREA), (640, 480), 0.5)
    assert half.shape == (240, 320, 3)

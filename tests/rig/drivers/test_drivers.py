"""One contract for every driver, and what each does when its camera is not there."""

import dataclasses
import json
import socket
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.drivers.base import CameraLost, CameraNotFound, Driver, DriverMissing, GrabTimeout, driver_for, upright
from rig.drivers.opencv import VideoCaptureDriver
from rig.drivers.simulated import SimulatedDriver
from rig.formats.rig_toml import CameraConfig
from rig.studio.devices.serve import StudioDevices
from tests.support.frames import grab_frame
from tests.support.textured_studio import FlatStudio

Make = Callable[[], Driver]


@pytest.fixture
def make(request: pytest.FixtureRequest) -> Make:
    """Makes drivers of one kind; each kind has a camera at hand."""

    def config(driver: str, identity: str, **more: object) -> CameraConfig:
        return dataclasses.replace(
            CameraConfig(name="cam00", driver="opencv", identity=identity),
            **{"driver": driver, "trigger": "free", **more},
        )

    kind = request.param
    if kind in ("opencv-http", "opencv-capture"):
        url = request.getfixturevalue("studio").streams.url("cam00")
        camera = config("opencv", url)
        return (lambda: driver_for(camera, Path())) if kind == "opencv-http" else (lambda: VideoCaptureDriver(camera))
    if kind == "replay":
        camera, folder = config("replay", "."), request.getfixturevalue("recorded")
        return lambda: driver_for(camera, folder)
    if kind == "node":
        camera = config("node", request.getfixturevalue("node"), width=160, height=120)
        return lambda: driver_for(camera, Path())
    if kind == "genicam":
        camera = config("genicam", request.getfixturevalue("gige"), width=256, height=256, fps=20.0)
        return lambda: driver_for(camera, Path())
    return lambda: SimulatedDriver(config("simulated", "x"), "cam00", source=FlatStudio(True))


def drain(driver: Driver, timeout_s: float) -> None:
    """Grabs what waits already, until nothing comes in time."""
    for _ in range(100):
        driver.grab(timeout_s)


@pytest.mark.parametrize(
    "make", ["opencv-http", "opencv-capture", "node", "replay", "genicam", "simulated"], indirect=True
)
def test_contract(make: Make) -> None:
    driver = make()
    with pytest.raises(CameraLost):
        driver.grab(0.1)
    with closing(driver):
        driver.open(5.0)
        assert driver.configure() == ()
        frames = [grab_frame(driver, 2.0) for _ in range(3)]
        driver.trigger()
        if not isinstance(driver, VideoCaptureDriver):  # it cannot wait for less than a second
            with pytest.raises(GrabTimeout):
                drain(driver, 0.001)
        assert grab_frame(driver, 2.0).image.shape == frames[0].image.shape
        driver.close()
    assert all(frame.image.dtype == np.uint8 and frame.image.ndim == 3 for frame in frames)
    assert all(frame.image.flags.writeable or not driver.live for frame in frames)
    times = [frame.time_s for frame in frames]
    assert times == sorted(times)
    assert time.monotonic() - 100 < times[0] <= time.monotonic()
    assert frames[0].sequence < frames[1].sequence < frames[2].sequence
    if driver.live:
        assert not np.array_equal(frames[0].image, frames[1].image)
    with pytest.raises(CameraLost):
        driver.grab(0.1)
    driver.open(5.0)
    assert grab_frame(driver, 2.0).image.size
    driver.close()


@pytest.mark.parametrize("make", ["opencv-http", "opencv-capture", "replay", "simulated"], indirect=True)
def test_pictures_are_rgb_and_true(make: Make) -> None:
    driver = make()
    with closing(driver):
        driver.open(5.0)
        image = grab_frame(driver, 2.0).image
    wall = FlatStudio(False)._wall(0)
    # The upper left quarter is wall in every picture. Noise of 2 and JPEG average out over a 10 px block to under 1;
    # swapped channels would be off by 30 on average.
    blocks = [
        cv2.resize(part[:120, :80].astype(np.float32), (8, 12), interpolation=cv2.INTER_AREA) for part in (image, wall)
    ]
    assert np.abs(blocks[0] - blocks[1]).mean() < 1.5


@pytest.mark.parametrize("make", ["opencv-http", "opencv-capture"], indirect=True)
def test_a_stream_that_hangs_is_let_go(make: Make, studio: StudioDevices) -> None:
    driver = make()
    driver.open(5.0)
    try:
        grab_frame(driver, 2.0)
        studio.streams.disturb("cam00", hung=True)
        started_s = time.monotonic()
        with pytest.raises((GrabTimeout, CameraLost)):
            drain(driver, 0.3)
        assert time.monotonic() - started_s < 20.0, "FFmpeg itself waits for half a minute"
    finally:
        studio.streams.disturb("cam00")
        driver.close()


@pytest.mark.parametrize(
    ("driver", "identity"),
    [
        ("opencv", "http://127.0.0.1:9/cam.mjpeg"),
        ("opencv", "/dev/v4l/by-id/usb-nothing-video-index0"),
        ("opencv", "rtsp://127.0.0.1:9/stream"),
        ("replay", "nowhere"),
        ("simulated", "nowhere.ply"),
    ],
)
def test_a_camera_that_is_not_there(driver: str, identity: str, tmp_path: Path) -> None:
    camera = dataclasses.replace(CameraConfig(name="cam07", driver="opencv", identity=identity), **{"driver": driver})
    opened = driver_for(camera, tmp_path)
    with pytest.raises(CameraNotFound, match="cam07: there is no camera") as caught:
        opened.open(1.0)
    assert identity in str(caught.value)
    opened.close()


def test_settings_that_cannot_be_met_are_said(studio: StudioDevices) -> None:
    camera = CameraConfig(name="cam00", driver="opencv", identity=studio.streams.url("cam00"), exposure_ms=5.0)
    assert "exposure_ms" in driver_for(camera, Path()).configure()[0].text


def test_a_missing_vendor_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(DriverMissing, match=r"eigenhead\[gphoto\]") as caught:
        driver_for(CameraConfig(name="cam04", driver="gphoto", identity="1234"), Path())
    assert "\n" not in str(caught.value)


def test_the_studio_can_be_operated_over_its_port(studio: StudioDevices) -> None:
    def ask(method: str, path: str) -> tuple[int, str]:
        with socket.create_connection(("127.0.0.1", studio.streams.port), 5) as connection:
            connection.sendall(f"{method} {path} HTTP/1.0\r\n\r\n".encode())
            answer = b"".join(iter(lambda: connection.recv(65536), b"")).decode()
        return int(answer.split()[1]), answer.partition("\r\n\r\n")[2]

    status, page = ask("GET", "/")
    assert status == 200
    assert "/cam01.mjpeg" in page
    assert ask("POST", "/subject?present=1")[1].startswith("subject seated")
    assert ask("POST", "/subject?present=0")[1].startswith("empty")
    assert "faults: dark cam01" in ask("POST", "/faults?kind=dark&camera=cam01")[1]
    status, text = ask("POST", "/faults?kind=drak&camera=cam77")
    assert status == 422
    assert "kind" in text
    assert "camera" in text
    assert ask("DELETE", "/faults")[1].strip().endswith("none")
    assert ask("GET", "/nothing")[0] == 404
    assert json.dumps(str(studio.port_link)) in (studio.folder / "rig.toml").read_text()


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_upright_turns_clockwise(rotation_deg: int) -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[0, 0] = 255  # top left; a quarter turn clockwise takes it to the top right
    turned = upright(image, rotation_deg)
    corner = {0: (0, 0), 90: (0, -1), 180: (-1, -1), 270: (-1, 0)}[rotation_deg]
    assert turned[corner].tolist() == [255] * 3
    assert turned.shape == ((4, 6, 3) if rotation_deg % 180 == 0 else (6, 4, 3))


def test_a_gige_camera_by_another_serial_number_is_not_taken(gige: str) -> None:
    camera = CameraConfig(name="cam00", driver="genicam", identity="EH6")
    with pytest.raises(CameraNotFound, match=f"serial numbers found: .*{gige}"):
        driver_for(camera, Path()).open(2.0)


def test_a_gige_camera_waits_for_software_triggers(gige: str) -> None:
    camera = CameraConfig(name="cam00", driver="genicam", identity=gige, trigger="software", width=256, height=256)
    driver = driver_for(camera, Path())
    with closing(driver):
        driver.open(5.0)
        assert driver.configure() == ()
        with pytest.raises(GrabTimeout):
            drain(driver, 0.4)
        asked_s = time.monotonic()
        driver.trigger()
        assert driver.grab(1.0).time_s >= asked_s

"""One contract for every driver, and what each does when its camera is not there."""

import contextlib
import dataclasses
import json
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.acquisition.trigger import TriggerBox
from rig.drivers import gphoto
from rig.drivers.base import (
    Arrival,
    CameraLost,
    CameraNotFound,
    Driver,
    DriverError,
    DriverMissing,
    GrabTimeout,
    grab_frame,
    upright,
)
from rig.drivers.feed import CameraFeed
from rig.drivers.opencv import VideoCaptureDriver
from rig.drivers.registry import driver_for
from rig.drivers.simulated import SimulatedDriver
from rig.formats.rig_toml import CameraConfig
from rig.studio.devices.serve import StudioDevices
from tests.support.textured_studio import NAMES, FlatStudio

Make = Callable[[], Driver]


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StudioDevices]:
    with StudioDevices(
        tmp_path_factory.mktemp("studio"), NAMES[:2], FlatStudio(False), FlatStudio(True), fps=10, takes=3
    ) as devices:
        with TriggerBox(str(devices.port_link)) as box:
            box.set_lights(1)
        yield devices


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    (folder / "images").mkdir()
    image = FlatStudio(True)("cam00", 0.0)
    cv2.imwrite(str(folder / "images" / "cam00.png"), image[:, :, ::-1])
    return folder


@pytest.fixture(scope="module")
def gige() -> Iterator[str]:
    """A GigE Vision camera on the loopback; its serial number."""
    if shutil.which("arv-fake-gv-camera-0.8") is None:
        pytest.skip("needs Debian's aravis-tools: no GigE Vision camera to open")
    with subprocess.Popen(["arv-fake-gv-camera-0.8", "-i", "127.0.0.1", "-s", "EH5"]) as process:
        time.sleep(0.5)
        yield "EH5"
        process.terminate()


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
    if kind == "genicam":
        camera = config("genicam", request.getfixturevalue("gige"), width=256, height=256, fps=20.0)
        return lambda: driver_for(camera, Path())
    return lambda: SimulatedDriver(config("simulated", "x"), "cam00", source=FlatStudio(True))


KINDS = pytest.mark.parametrize(
    "make", ["opencv-http", "opencv-capture", "replay", "genicam", "simulated"], indirect=True
)


def drain(driver: Driver, timeout_s: float) -> None:
    """Grabs what waits already, until nothing comes in time."""
    for _ in range(100):
        driver.grab(timeout_s)


@KINDS
def test_contract(make: Make) -> None:
    driver = make()
    with pytest.raises(CameraLost):
        driver.grab(0.1)
    driver.open(5.0)
    try:
        assert driver.configure() == ()
        frames = [grab_frame(driver, 2.0) for _ in range(3)]
        driver.trigger()
        if not isinstance(driver, VideoCaptureDriver):  # it cannot wait for less than a second
            with pytest.raises(GrabTimeout):
                drain(driver, 0.001)
        assert grab_frame(driver, 2.0).image.shape == frames[0].image.shape
    finally:
        driver.close()
        driver.close()
    assert all(frame.image.dtype == np.uint8 and frame.image.ndim == 3 for frame in frames)
    assert all(frame.image.flags.writeable or not driver.live for frame in frames)
    times = [frame.time_s for frame in frames]
    assert times == sorted(times)
    assert time.monotonic() - 10 < times[0] <= time.monotonic()
    assert frames[0].sequence < frames[1].sequence < frames[2].sequence
    if driver.live:
        assert not np.array_equal(frames[0].image, frames[1].image)
    with pytest.raises(CameraLost):
        driver.grab(0.1)


@pytest.mark.parametrize("make", ["opencv-http", "opencv-capture", "replay", "simulated"], indirect=True)
def test_pictures_are_rgb_and_true(make: Make) -> None:
    driver = make()
    driver.open(5.0)
    try:
        image = grab_frame(driver, 2.0).image
    finally:
        driver.close()
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
        studio.streams.hang("cam00")
        started_s = time.monotonic()
        with pytest.raises((GrabTimeout, CameraLost)):
            drain(driver, 0.3)
        assert time.monotonic() - started_s < 3.0
    finally:
        studio.streams.hang("cam00", False)
        driver.close()


@KINDS
def test_a_driver_can_be_opened_again(make: Make) -> None:
    driver = make()
    for _ in range(2):
        driver.open(5.0)
        assert grab_frame(driver, 2.0).image.size
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
    with pytest.raises(CameraNotFound, match="cam07: no camera") as caught:
        opened.open(1.0)
    assert identity in str(caught.value)
    opened.close()


def test_a_gige_camera_by_another_serial_number_is_not_taken(gige: str) -> None:
    camera = CameraConfig(name="cam00", driver="genicam", identity="EH6")
    with pytest.raises(CameraNotFound, match=f"serial numbers found: .*{gige}"):
        driver_for(camera, Path()).open(2.0)


def test_a_gige_camera_waits_for_software_triggers(gige: str) -> None:
    camera = CameraConfig(name="cam00", driver="genicam", identity=gige, trigger="software", width=256, height=256)
    driver = driver_for(camera, Path())
    driver.open(5.0)
    try:
        assert driver.configure() == ()
        with pytest.raises(GrabTimeout):
            drain(driver, 0.4)
        asked_s = time.monotonic()
        driver.trigger()
        assert driver.grab(1.0).time_s >= asked_s
    finally:
        driver.close()


def test_settings_that_cannot_be_met_are_said(studio: StudioDevices) -> None:
    camera = CameraConfig(name="cam00", driver="opencv", identity=studio.streams.url("cam00"), exposure_ms=5.0)
    assert "exposure_ms" in driver_for(camera, Path()).configure()[0]


def test_a_missing_vendor_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(DriverMissing, match=r"eigenhead\[gphoto\]") as caught:
        driver_for(CameraConfig(name="cam04", driver="gphoto", identity="1234"), Path())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("value", "choices", "chosen"),
    [
        (0.008, ["1/60", "1/125", "1/250", "bulb"], "1/125"),
        (0.5, ["1", "0.5s", "0.3"], "0.5s"),
        (0.01, ["1/60", "1/500"], None),
        ("Large Fine JPEG", ["RAW", "Large Fine JPEG"], "Large Fine JPEG"),
        ("TIFF", ["RAW"], None),
        (5000, ["4800", "5000"], "5000"),
    ],
)
def test_dslr_settings_are_the_nearest_choice(value: object, choices: list[str], chosen: str | None) -> None:
    assert gphoto._nearest_choice(value, choices) == chosen


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_upright_turns_clockwise(rotation_deg: int) -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[0, 0] = 255  # top left; a quarter turn clockwise takes it to the top right
    turned = upright(image, rotation_deg)
    corner = {0: (0, 0), 90: (0, -1), 180: (-1, -1), 270: (-1, 0)}[rotation_deg]
    assert turned[corner].tolist() == [255] * 3
    assert turned.shape == ((4, 6, 3) if rotation_deg % 180 == 0 else (6, 4, 3))


def serve_bytes(answer: bytes, pause_s: float = 0.0) -> tuple[int, Callable[[], None]]:
    """A server that sends ``answer`` once, in two halves, and hangs up; its port and how to end it."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with contextlib.suppress(OSError):
            connection, _ = listener.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(answer[: len(answer) // 2])
                time.sleep(pause_s)
                connection.sendall(answer[len(answer) // 2 :])

    thread = threading.Thread(target=serve)
    thread.start()

    def end() -> None:
        with contextlib.suppress(OSError):
            socket.create_connection(("127.0.0.1", listener.getsockname()[1]), 1).close()
        thread.join()
        listener.close()

    return listener.getsockname()[1], end


def jpeg(value: int) -> bytes:
    return cv2.imencode(".jpg", np.full((8, 8, 3), value, np.uint8))[1].tobytes()


HEAD = b'HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary="--b"\r\n\r\n'


@pytest.mark.parametrize("with_length", [True, False])
def test_streams_with_and_without_lengths_and_cut_by_timeouts(with_length: bool) -> None:
    parts = b""
    for value in (10, 200):
        length = b"Content-Length: %d\r\n" % len(jpeg(value)) if with_length else b""
        parts += b"--b\r\nContent-Type: image/jpeg\r\n" + length + b"\r\n" + jpeg(value) + b"\r\n"
    port, end = serve_bytes(HEAD + parts + b"--b\r\n", pause_s=0.3)
    driver = driver_for(CameraConfig(name="c", driver="opencv", identity=f"http://u:p@127.0.0.1:{port}/"), Path())
    try:
        driver.open(1.0)
        means = []
        for _ in range(100):
            try:
                means.append(float(grab_frame(driver, 0.05).image.mean()))
            except GrabTimeout:
                continue
            except CameraLost:
                break
    finally:
        driver.close()
        end()
    assert means == pytest.approx([10, 200], abs=2)


def test_arrival_is_when_the_frame_came_not_when_it_was_read() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    picture = cv2.imencode(".jpg", noise)[1].tobytes()  # more than a reader takes with the header before it
    part = b"--b\r\nContent-Length: %d\r\n\r\n" % len(picture) + picture + b"\r\n"
    sent = HEAD + 2 * part
    with socket.socket() as stamped:
        stamped.setsockopt(socket.SOL_SOCKET, 35, 1)  # the kernel begins to stamp some time after the first who asks
        time.sleep(0.1)
        port, end = serve_bytes(sent + b"\r\n" * (len(sent) // 2), pause_s=0.5)
        driver = driver_for(CameraConfig(name="c", driver="opencv", identity=f"http://127.0.0.1:{port}/"), Path())
        try:
            driver.open(1.0)
            driver.grab(1.0)
            time.sleep(0.3)
            assert driver.grab(1.0).time_s < time.monotonic() - 0.2
        finally:
            driver.close()
            end()


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (b"HTTP/1.0 404 Not Found\r\n\r\n", "HTTP status 404"),
        (b"HTTP/1.0 200 OK\r\nContent-Type: text/html\r\n\r\n<html>", "no motion JPEG"),
        (b"SSH-2.0-OpenSSH_9.2\r\n\r\n", "something else than HTTP"),
    ],
)
def test_addresses_that_serve_no_stream(answer: bytes, why: str) -> None:
    port, end = serve_bytes(answer)
    driver = driver_for(CameraConfig(name="c", driver="opencv", identity=f"http://127.0.0.1:{port}/"), Path())
    try:
        with pytest.raises(CameraNotFound, match=why):
            driver.open(1.0)
    finally:
        end()


class HangingDriver:
    """A camera whose vendor's library never comes back, until the test lets it."""

    live = True

    def __init__(self) -> None:
        self.let_go = threading.Event()

    def open(self, timeout_s: float) -> None:
        self.let_go.wait()
        raise DriverError("cam01", "let go")

    def configure(self) -> tuple[str, ...]:
        return ()

    def grab(self, timeout_s: float) -> Arrival:
        raise AssertionError("it was never open")

    def retrieve(self) -> np.ndarray:
        raise AssertionError("it was never open")

    def trigger(self) -> None:
        return

    def close(self) -> None:
        return


def test_a_hanging_camera_does_not_hold_the_others() -> None:
    hanging = HangingDriver()
    camera = CameraConfig(name="cam00", driver="simulated", identity="x", fps=50.0, rotation_deg=90)
    feeds = [
        CameraFeed(dataclasses.replace(camera, name="cam01"), hanging, 1.0),
        CameraFeed(camera, SimulatedDriver(camera, "cam00", source=FlatStudio(True)), 1.0),
    ]
    started_s = time.monotonic()
    for feed in feeds:
        feed.start()
    assert feeds[1].wait_opened(started_s + 1.0)
    assert feeds[1].wait_frames(3, started_s + 1.0)
    assert not feeds[0].wait_opened(time.monotonic() + 0.1)
    now_s = time.monotonic()
    feeds[1].want(now_s)
    frame = feeds[1].collect(now_s, now_s + 1.0)
    assert frame is not None
    assert frame.image.shape == (320, 240, 3)
    assert frame.time_s >= now_s
    assert feeds[0].collect(now_s, now_s + 0.05) is None
    assert feeds[1].close(time.monotonic() + 1.0)
    assert not feeds[0].close(time.monotonic() + 0.1)
    hanging.let_go.set()
    assert feeds[0].close(time.monotonic() + 1.0)
    assert feeds[0].state().error == "cam01: let go"


def test_a_camera_that_comes_back_is_opened_again(recorded: Path, tmp_path: Path) -> None:
    camera = CameraConfig(name="cam00", driver="replay", identity="later")
    feed = CameraFeed(camera, driver_for(camera, tmp_path), 1.0)
    feed.start()
    try:
        assert not feed.wait_opened(time.monotonic() + 1.0)
        assert "no camera 'later'" in (feed.state().error or "")
        shutil.copytree(recorded, tmp_path / "later")
        deadline_s = time.monotonic() + 5.0
        while not feed.state().opened and time.monotonic() < deadline_s:
            time.sleep(0.02)
        assert feed.state().opened
        assert feed.state().error is None
    finally:
        feed.close(time.monotonic() + 2.0)


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

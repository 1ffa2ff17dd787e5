"""Video devices: which settings count as taken. Streams over HTTP: with and without lengths, cut by timeouts, and
addresses that serve none."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.drivers import opencv
from rig.drivers.base import CameraLost, CameraNotFound, GrabTimeout, driver_for
from rig.formats.rig_toml import CameraConfig
from tests.support.frames import grab_frame

FOURCC = cv2.VideoWriter.fourcc


@pytest.mark.parametrize(
    ("prop", "wanted", "found", "is_taken"),
    [
        (cv2.CAP_PROP_FOURCC, FOURCC(*"MJPG"), FOURCC(*"MJPG"), True),
        (cv2.CAP_PROP_FOURCC, FOURCC(*"MJPG"), FOURCC(*"JPEG"), False),  # 0.3 % apart as numbers
        (cv2.CAP_PROP_FOURCC, FOURCC(*"NV12"), FOURCC(*"YU12"), False),
        (cv2.CAP_PROP_EXPOSURE, 83.0, 80.0, True),
        (cv2.CAP_PROP_FRAME_WIDTH, 1920, 1280, False),
    ],
)
def test_a_setting_is_taken(prop: int, wanted: float, found: float, is_taken: bool) -> None:
    assert opencv._is_taken(prop, wanted, found) == is_taken


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
        driver.open(20.0)
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
            driver.open(20.0)
            driver.grab(20.0)
            time.sleep(0.3)
            assert driver.grab(20.0).time_s < time.monotonic() - 0.2
        finally:
            driver.close()
            end()


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (b"HTTP/1.0 404 Not Found\r\n\r\n", "HTTP status 404"),
        (b"HTTP/1.0 200 OK\r\nContent-Type: text/html\r\n\r\n<html>", "no motion JPEG"),
        (b"SSH-2.0-OpenSSH_9.2\r\n\r\n", "something other than HTTP"),
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

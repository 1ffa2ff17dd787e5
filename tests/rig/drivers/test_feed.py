"""A camera's feed: one that hangs, and one that comes back."""

import dataclasses
import shutil
import threading
import time
from pathlib import Path

import numpy as np

from rig.drivers.base import Arrival, DriverError, driver_for
from rig.drivers.feed import CameraFeed
from rig.drivers.simulated import SimulatedDriver
from rig.formats.rig_toml import CameraConfig
from rig.messages.message import Message, verbatim
from tests.support.textured_studio import FlatStudio


class HangingDriver:
    """A camera whose vendor's library never comes back, until the test lets it."""

    live = True

    def __init__(self) -> None:
        self.let_go = threading.Event()

    def open(self, timeout_s: float) -> None:
        self.let_go.wait()
        raise DriverError("cam01", verbatim("let go"))

    def configure(self) -> tuple[Message, ...]:
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
    for feed in feeds:
        feed.start()
    until_s = time.monotonic() + 60.0  # nothing waits so long
    assert feeds[1].wait_opened(until_s)
    assert feeds[1].wait_frames(3, until_s)
    assert not feeds[0].wait_opened(time.monotonic() + 0.1)
    now_s = time.monotonic()
    feeds[1].want(now_s)
    frame = feeds[1].collect(now_s, until_s)
    assert frame is not None
    assert frame.image.shape == (320, 240, 3)
    assert frame.time_s >= now_s
    assert feeds[0].collect(now_s, now_s + 0.05) is None
    assert feeds[1].close(until_s)
    assert not feeds[0].close(time.monotonic() + 0.1)
    hanging.let_go.set()
    assert feeds[0].close(until_s)
    assert str(feeds[0].state().error) == "cam01: let go"


def test_a_camera_that_comes_back_is_opened_again(recorded: Path, tmp_path: Path) -> None:
    camera = CameraConfig(name="cam00", driver="replay", identity="later")
    feed = CameraFeed(camera, driver_for(camera, tmp_path), 1.0)
    feed.start()
    try:
        assert not feed.wait_opened(time.monotonic() + 1.0)
        assert "no camera 'later'" in str(feed.state().error)
        shutil.copytree(recorded, tmp_path / "later")
        deadline_s = time.monotonic() + 60.0
        while not feed.state().opened and time.monotonic() < deadline_s:
            time.sleep(0.02)
        assert feed.state().opened
        assert feed.state().error is None
    finally:
        feed.close(time.monotonic() + 2.0)

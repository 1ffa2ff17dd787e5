"""GigE Vision cameras, before a simulated one of Aravis."""

import time
from pathlib import Path

import pytest

from rig.drivers.base import CameraNotFound, GrabTimeout, driver_for
from rig.formats.rig_toml import CameraConfig
from tests.rig.drivers.test_drivers import drain


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

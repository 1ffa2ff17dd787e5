"""A Raspberry Pi's node, run as on the Pi but for its camera: settings, the software trigger, who may ask."""

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig.drivers.base import CameraLost, CameraNotFound, GrabTimeout, driver_for
from rig.formats.rig_toml import CameraConfig
from tests.rig.drivers.conftest import run_node
from tests.support.frames import grab_frame
from tests.support.raspberry_pi.picamera2 import ENCODING_S

SMALL = CameraConfig(
    name="pi03", driver="node", identity="", trigger="software", width=160, height=120, exposure_ms=12.0
)


def test_a_picture_is_exposed_after_the_trigger_and_stamped_when_that_began(node: str) -> None:
    driver = driver_for(replace(SMALL, identity=node), Path())
    with closing(driver):
        driver.open(5.0)
        assert driver.configure() == ()
        with pytest.raises(GrabTimeout):  # it waits for its command
            driver.grab(0.2)
        for _ in range(2):
            before_s = time.monotonic()
            driver.trigger()
            frame = grab_frame(driver, 5.0)
            assert before_s <= frame.time_s <= time.monotonic() - ENCODING_S  # not when it had been encoded and sent
            assert frame.image.shape == (120, 160, 3)
            assert float(np.mean(frame.image[20:])) == pytest.approx(120.0, abs=2.0)  # of the exposure


def test_settings_that_the_pi_does_not_take_are_named(node: str) -> None:
    camera = replace(SMALL, identity=node, trigger="free", width=161, gain_db=60.0, white_balance_k=5200, fps=20.0)
    driver = driver_for(camera, Path())
    with closing(driver):
        driver.open(5.0)
        said = " ".join(message.text for message in driver.configure())
        assert [key in said for key in ("width", "gain_db", "white_balance_k", "fps")] == [True, True, True, False]
        assert grab_frame(driver, 5.0).image.shape == (120, 160, 3)
        driver.trigger()  # of a free camera: nothing


def test_a_node_with_a_login_answers_nobody_else(tmp_path: Path) -> None:
    (tmp_path / "login").write_text("rig:secret\n")
    with run_node("--login", str(tmp_path / "login")) as address:
        stranger = driver_for(replace(SMALL, identity=address), Path())
        with pytest.raises(CameraNotFound, match="401"):
            stranger.open(5.0)
        with pytest.raises(CameraLost, match="401"):
            stranger.trigger()
        driver = driver_for(replace(SMALL, identity=address.replace("//", "//rig:secret@")), Path())
        driver.open(5.0)
        driver.trigger()
        assert grab_frame(driver, 5.0).image.size
        driver.close()


def test_what_is_no_stream_is_refused(node: str) -> None:
    with pytest.raises(CameraNotFound, match="404"):
        driver_for(replace(SMALL, driver="opencv", identity=f"{node}/else"), Path()).open(5.0)
    with pytest.raises(CameraNotFound, match="400"):
        driver_for(replace(SMALL, driver="opencv", identity=f"{node}/stream?width=wide"), Path()).open(5.0)

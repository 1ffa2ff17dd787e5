"""Cameras that every test of a driver may open."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import pytest

from rig.acquisition.trigger import TriggerBox
from rig.drivers.base import CameraNotFound, driver_for
from rig.formats.rig_toml import CameraConfig
from rig.studio.devices.serve import StudioDevices
from tests.support.textured_studio import NAMES, FlatStudio

ROOT = Path(__file__).resolve().parents[3]
STAND_IN = ROOT / "tests" / "support" / "raspberry_pi"


@contextmanager
def run_node(*options: str) -> Iterator[str]:
    """Runs the program of a Raspberry Pi on this machine; its address."""
    command = [sys.executable, str(ROOT / "deploy" / "raspberry_pi" / "node.py"), "--host", "127.0.0.1", "--port", "0"]
    environment = os.environ | {"PYTHONPATH": str(STAND_IN)}
    with subprocess.Popen([*command, *options], env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = process.stdout.readline().split()[-1]
        yield f"http://127.0.0.1:{port}"
        process.terminate()


@pytest.fixture(scope="module")
def node() -> Iterator[str]:
    with run_node() as address:
        yield address


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
    camera = CameraConfig(name="cam00", driver="genicam", identity="EH5", width=256, height=256)
    with subprocess.Popen(["arv-fake-gv-camera-0.8", "-i", "127.0.0.1", "-s", "EH5"]) as process:
        driver, until_s = driver_for(camera, Path()), time.monotonic() + 60.0
        while process.poll() is None and time.monotonic() < until_s:
            with suppress(CameraNotFound):  # it has not begun to answer
                driver.open(1.0)
                break
        driver.close()
        yield "EH5"
        process.terminate()

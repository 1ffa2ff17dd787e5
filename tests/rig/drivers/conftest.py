"""Cameras that every test of a driver may open."""

import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from rig.acquisition.trigger import TriggerBox
from rig.studio.devices.serve import StudioDevices
from tests.support.textured_studio import NAMES, FlatStudio


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

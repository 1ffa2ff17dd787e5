"""SLR cameras: which of a camera's choices is taken, and at which port a camera is found."""

from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from rig.drivers import gphoto
from rig.drivers.base import CameraNotFound
from rig.formats.rig_toml import CameraConfig


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


class Bus:
    """Of libgphoto2 what finding a camera takes: one camera, which is plugged in at ``port``."""

    GPhoto2Error = RuntimeError

    def __init__(self, port: str, serial: str) -> None:
        self.port, self.serial, self.looked = port, serial, 0
        self.Camera = lambda: self
        self.PortInfoList = lambda: self
        self.Camera.autodetect = self._autodetect  # pyright: ignore[reportFunctionMemberAccess]

    def _autodetect(self) -> SimpleNamespace:
        self.looked += 1
        return SimpleNamespace(count=lambda: 1, get_value=lambda index: self.port)

    def load(self) -> None: ...
    def init(self) -> None: ...
    def set_port_info(self, info: str) -> None: ...
    def gp_camera_exit(self, device: object) -> None: ...

    def lookup_path(self, port: str) -> str:
        if port != self.port:
            raise self.GPhoto2Error("Unknown port")
        return port

    def __getitem__(self, port: str) -> str:
        return port

    def get_single_config(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(get_value=lambda: self.serial)


@pytest.fixture
def no_ports_known() -> Iterator[None]:
    gphoto._ports_by_serial.clear()
    yield
    gphoto._ports_by_serial.clear()


def test_a_camera_that_is_plugged_in_anew_is_found_at_its_new_port(no_ports_known: None) -> None:
    bus = Bus("usb:001,004", "000012345")
    driver = gphoto.GphotoDriver(CameraConfig(name="cam00", driver="gphoto", identity="0012345"), bus)
    driver.open(1.0)
    driver.open(1.0)
    assert bus.looked == 1, "the bus is walked once, whatever zeros a label has"
    bus.port = "usb:001,007"
    with pytest.raises(CameraNotFound, match="Unknown port"):
        driver.open(1.0)
    driver.open(1.0)

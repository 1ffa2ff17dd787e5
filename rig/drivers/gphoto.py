"""Controls DSLRs and other PTP cameras through python-gphoto2 (optional dependency group ``gphoto``).

In rig.toml, ``identity`` is the camera's serial number, or a network address such as ``ptpip:192.168.1.7``. The trigger
box releases the shutter by a cable (``trigger = "external"``), or the host releases it by a command (``trigger =
"software"``). The camera must be set to JPEG; its memory card is not used.
"""

import importlib
import threading
import time
from pathlib import Path
from typing import Any

from rig.drivers.base import Arrival, CameraLost, CameraNotFound, Driver, DriverMissing, GrabTimeout
from rig.drivers.opencv import decode_jpeg
from rig.errors import how_to_install
from rig.formats.rig_toml import CameraConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose

# Two cameras that open at once would both walk the USB bus and claim each other's interface.
_bus = threading.Lock()
_ports_by_serial: dict[str, str] = {}


def make(camera: CameraConfig, folder: Path) -> Driver:
    """Returns the driver for a DSLR. Raises DriverMissing."""
    try:
        return GphotoDriver(camera, importlib.import_module("gphoto2"))
    except ImportError as error:
        raise DriverMissing(
            camera, compose("located", where="python-gphoto2", fault=how_to_install("gphoto"))
        ) from error


class GphotoDriver:
    """Controls one DSLR, or another camera with PTP, through libgphoto2."""

    live = True

    def __init__(self, camera: CameraConfig, gphoto: Any) -> None:
        self._camera = camera
        self._gp = gphoto
        self._device: Any = None
        self._file: tuple[str, str] | None = None
        self._sequence = 0

    def open(self, timeout_s: float) -> None:
        """Finds the camera by its serial number or network address and opens it. Raises CameraNotFound."""
        self.close()
        try:
            with _bus:
                self._device = self._open_port(self._port())
        except self._gp.GPhoto2Error as error:
            _ports_by_serial.pop(_serial_of(self._camera), None)  # plugged in anew it has another port
            raise CameraNotFound(self._camera, str(error)) from error

    def configure(self) -> tuple[Message, ...]:
        """Applies the settings of rig.toml. Returns one message for each setting that the camera refused, which always
        includes a gain."""
        camera = self._camera
        wanted: list[tuple[str, str, Any]] = [("capturetarget", "capturetarget", "Internal RAM")]
        if camera.pixel_format is not None:
            wanted.append(("pixel_format", "imageformat", camera.pixel_format))
        if camera.exposure_ms is not None:
            wanted.append(("exposure_ms", "shutterspeed", camera.exposure_ms / 1000))
        if camera.white_balance_k is not None:
            wanted.append(("white_balance_k", "colortemperature", camera.white_balance_k))
        unmet = [] if camera.gain_db is None else [compose("no-gain-on-camera")]
        for key, name, value in wanted:
            if not self._set(name, value) and key != "capturetarget":
                unmet.append(compose("setting-refused", setting=key, value=str(value)))
        return tuple(unmet)

    def grab(self, timeout_s: float) -> Arrival:
        """Waits until libgphoto2 reports a new picture, whose time of arrival is the time of the report. Raises
        GrabTimeout and CameraLost."""
        deadline_s = time.monotonic() + timeout_s
        try:
            while (left_s := deadline_s - time.monotonic()) > 0:
                kind, data = self._opened().wait_for_event(max(1, round(left_s * 1000)))
                if kind == self._gp.GP_EVENT_FILE_ADDED:
                    self._file = (data.folder, data.name)
                    self._sequence += 1
                    return Arrival(time.monotonic(), self._sequence)
        except self._gp.GPhoto2Error as error:
            raise CameraLost(self._camera, str(error)) from error
        raise GrabTimeout(self._camera, timeout_s)

    def retrieve(self) -> ImageRgb:
        """Downloads and decodes the picture of the last ``grab``. Raises CameraLost for a lost camera, and DriverError
        for a damaged file."""
        if self._file is None:
            raise CameraLost(self._camera, compose("no-picture-grabbed"))
        try:
            file = self._opened().file_get(*self._file, self._gp.GP_FILE_TYPE_NORMAL)
            return decode_jpeg(self._camera, bytes(memoryview(file.get_data_and_size())))
        except self._gp.GPhoto2Error as error:
            raise CameraLost(self._camera, str(error)) from error

    def trigger(self) -> None:
        """Releases the shutter, if rig.toml sets a software trigger. Raises CameraLost."""
        if self._camera.trigger != "software":
            return
        try:
            self._opened().trigger_capture()
        except self._gp.GPhoto2Error as error:
            raise CameraLost(self._camera, compose("camera-does-not-release", reason=str(error))) from error

    def close(self) -> None:
        """Ends the connection to the camera."""
        device, self._device = self._device, None
        if device is not None:
            # the result is of no use: the cable may be out already
            self._gp.gp_camera_exit(device)

    def _opened(self) -> Any:
        if self._device is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        return self._device

    def _port(self) -> str:
        identity = self._camera.identity
        if identity.startswith("ptpip:"):
            return identity
        sought = _serial_of(self._camera)
        if sought not in _ports_by_serial:
            cameras = self._gp.Camera.autodetect()
            for port in [cameras.get_value(index) for index in range(cameras.count())]:
                serial = self._serial(port)
                if serial is not None:
                    _ports_by_serial[serial.lstrip("0")] = port
        port = _ports_by_serial.get(sought)
        if port is None:
            serials = ", ".join(sorted(_ports_by_serial)) or "none"
            raise CameraNotFound(self._camera, compose("serial-numbers-found", found=serials))
        return port

    def _serial(self, port: str) -> str | None:
        try:
            device = self._open_port(port)
        except self._gp.GPhoto2Error:
            return None  # busy: it belongs to a camera that is open already
        try:
            return str(device.get_single_config("serialnumber").get_value()).strip()
        except self._gp.GPhoto2Error:
            return None
        finally:
            self._gp.gp_camera_exit(device)

    def _open_port(self, port: str) -> Any:
        ports = self._gp.PortInfoList()
        ports.load()
        device = self._gp.Camera()
        device.set_port_info(ports[ports.lookup_path(port)])
        if port.startswith("ptpip:"):  # nothing is detected over a network: the protocol has to be named
            models = self._gp.CameraAbilitiesList()
            models.load()
            device.set_abilities(models[models.lookup_model("PTP/IP Camera")])
        device.init()
        return device

    def _set(self, name: str, value: Any) -> bool:
        """Sets one configuration value of the camera; a number is set to the nearest available choice. Returns whether
        the camera accepted the value."""
        try:
            widget = self._opened().get_single_config(name)
            choices = list(widget.get_choices()) if widget.get_type() == self._gp.GP_WIDGET_RADIO else []
            choice = _nearest_choice(value, choices) if choices else value
            if choice is None:
                return False
            widget.set_value(choice)
            self._opened().set_single_config(name, widget)
        except self._gp.GPhoto2Error:
            return False
        return True


def _serial_of(camera: CameraConfig) -> str:
    """Returns the serial number without leading zeros, because the number printed on the camera lacks these zeros."""
    return camera.identity.lstrip("0")


def _nearest_choice(value: Any, choices: list[str]) -> str | None:
    """Returns the choice equal to ``value`` or, for a number, the nearest choice within a third of a stop."""
    if isinstance(value, str):
        return value if value in choices else None
    numbers = [(abs(number / value - 1), choice) for choice in choices if (number := _number(choice)) is not None]
    best = min(numbers, default=None)
    return best[1] if best is not None and best[0] < 2 ** (1 / 3) - 1 else None


def _number(text: str) -> float | None:
    """Converts a shutter speed or colour temperature such as "1/125", "0.5" or "5200" to a number. Returns None for
    other texts."""
    numerator, _, denominator = text.strip().rstrip("s").partition("/")
    try:
        return float(numerator) / float(denominator or 1)
    except (ValueError, ZeroDivisionError):
        return None

"""Controls GigE Vision and USB3 Vision cameras through the library Aravis (Debian package libaravis-0.8-0).

In rig.toml, ``identity`` is the serial number, or the device's id or MAC address as `arv-tool-0.8` lists them. With
``trigger = "external"`` the camera waits for a signal on its input Line1, with ``trigger = "software"`` for a command.
With ``trigger = "free"`` the camera takes ``fps`` pictures a second.

The module calls Aravis through ctypes, because PyGObject would have to be compiled in every virtual environment. The
signatures of Aravis' functions are from https://aravisproject.github.io/aravis/aravis-stable/.
"""

import contextlib
import ctypes
import threading
import time
from ctypes import POINTER, byref, c_bool, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from rig.drivers.base import Arrival, CameraLost, CameraNotFound, Driver, DriverError, DriverMissing, GrabTimeout
from rig.formats.rig_toml import CameraConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose

_BUFFERS = 4
_SOURCES = {"external": b"Line1", "software": b"Software"}
# Pixel format naming convention 2.4 (EMVA): code to what cv2.cvtColor has to do. GenICam and OpenCV's long names both
# name a Bayer pattern by its first row.
_CONVERSIONS = {
    0x01080001: cv2.COLOR_GRAY2RGB,  # Mono8
    0x01080008: cv2.COLOR_BayerGRBG2RGB,
    0x01080009: cv2.COLOR_BayerRGGB2RGB,
    0x0108000A: cv2.COLOR_BayerGBRG2RGB,
    0x0108000B: cv2.COLOR_BayerBGGR2RGB,
    0x02180014: None,  # RGB8
    0x02180015: cv2.COLOR_BGR2RGB,
}
_discovery = threading.Lock()  # the device list is one for the whole process
LIBRARY = "libaravis-0.8.so.0"
BUFFER_SUCCESS = 0  # ARV_BUFFER_STATUS_SUCCESS
AUTO_OFF = 0  # ARV_AUTO_OFF
PACKET_SOCKET_DISABLED = 1  # ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED


class AravisError(Exception):
    """Reports that a call of Aravis failed, with the message from Aravis."""


class _GError(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


# name: result, arguments without the GError** that the functions of _MAY_FAIL take last
_PLAIN: dict[str, tuple[Any, list[Any]]] = {
    "arv_update_device_list": (None, []),
    "arv_get_n_devices": (c_uint, []),
    "arv_get_device_id": (c_char_p, [c_uint]),
    "arv_get_device_serial_nbr": (c_char_p, [c_uint]),
    "arv_get_device_physical_id": (c_char_p, [c_uint]),
    "arv_get_device_address": (c_char_p, [c_uint]),
    "arv_camera_is_gv_device": (c_bool, [c_void_p]),
    "arv_camera_gv_set_stream_options": (None, [c_void_p, c_uint]),
    "arv_buffer_new_allocate": (c_void_p, [c_size_t]),
    "arv_stream_push_buffer": (None, [c_void_p, c_void_p]),
    "arv_stream_timeout_pop_buffer": (c_void_p, [c_void_p, c_uint64]),
    "arv_buffer_get_status": (c_int, [c_void_p]),
    "arv_buffer_get_frame_id": (c_uint64, [c_void_p]),
    "arv_buffer_get_system_timestamp": (c_uint64, [c_void_p]),
    "arv_buffer_get_image_width": (c_int, [c_void_p]),
    "arv_buffer_get_image_height": (c_int, [c_void_p]),
    "arv_buffer_get_image_pixel_format": (c_uint32, [c_void_p]),
    "arv_buffer_get_image_data": (c_void_p, [c_void_p, POINTER(c_size_t)]),
}
_MAY_FAIL: dict[str, tuple[Any, list[Any]]] = {
    "arv_camera_new": (c_void_p, [c_char_p]),
    "arv_camera_create_stream": (c_void_p, [c_void_p, c_void_p, c_void_p]),
    "arv_camera_get_payload": (c_uint, [c_void_p]),
    "arv_camera_start_acquisition": (None, [c_void_p]),
    "arv_camera_stop_acquisition": (None, [c_void_p]),
    "arv_camera_set_region": (None, [c_void_p, c_int, c_int, c_int, c_int]),
    "arv_camera_set_pixel_format_from_string": (None, [c_void_p, c_char_p]),
    "arv_camera_set_exposure_time_auto": (None, [c_void_p, c_int]),
    "arv_camera_set_exposure_time": (None, [c_void_p, c_double]),
    "arv_camera_set_gain_auto": (None, [c_void_p, c_int]),
    "arv_camera_set_gain": (None, [c_void_p, c_double]),
    "arv_camera_set_frame_rate": (None, [c_void_p, c_double]),
    "arv_camera_set_trigger": (None, [c_void_p, c_char_p]),
    "arv_camera_clear_triggers": (None, [c_void_p]),
    "arv_camera_software_trigger": (None, [c_void_p]),
}


class Aravis:
    """Wraps the library libaravis. ``call`` runs a function of libaravis and converts a GError to AravisError."""

    def __init__(self) -> None:
        self._aravis = ctypes.CDLL(LIBRARY)
        self._gobject = ctypes.CDLL("libgobject-2.0.so.0")
        self._glib = ctypes.CDLL("libglib-2.0.so.0")
        self._gobject.g_object_unref.argtypes = [c_void_p]
        self._glib.g_error_free.argtypes = [c_void_p]
        for name, (result, arguments) in _PLAIN.items():
            function = getattr(self._aravis, name)
            function.restype, function.argtypes = result, arguments
        for name, (result, arguments) in _MAY_FAIL.items():
            function = getattr(self._aravis, name)
            function.restype, function.argtypes = result, [*arguments, POINTER(POINTER(_GError))]

    def call(self, name: str, *arguments: Any) -> Any:
        """Calls the library's function ``name`` and returns its result, a C string as str. Raises AravisError."""
        function = getattr(self._aravis, name)
        if name in _PLAIN:
            result = function(*arguments)
            return result.decode() if isinstance(result, bytes) else result
        error = POINTER(_GError)()
        result = function(*arguments, byref(error))
        if error:
            message = (error.contents.message or b"").decode("utf-8", "replace")
            self._glib.g_error_free(error)
            raise AravisError(message)
        return result

    def release(self, pointer: int) -> None:
        """Releases the reference ``pointer`` to a GObject."""
        self._gobject.g_object_unref(pointer)

    def pixels(self, buffer: int) -> UInt8[np.ndarray, " n"]:
        """Copies the bytes of the image in a buffer."""
        size = c_size_t()
        data = self._aravis.arv_buffer_get_image_data(buffer, byref(size))
        return np.frombuffer(ctypes.string_at(data, size.value), np.uint8)


@cache
def library() -> Aravis:
    """Returns the library libaravis, which the first call loads. Raises OSError if libaravis is not installed."""
    return Aravis()


def make(camera: CameraConfig, folder: Path) -> Driver:
    """Returns the driver for a GenICam camera. Raises DriverMissing."""
    try:
        return GenicamDriver(camera, library())
    except OSError as error:
        raise DriverMissing(camera, compose("needs-aravis")) from error


class GenicamDriver:
    """Controls one GigE Vision or USB3 Vision camera through Aravis."""

    live = True

    def __init__(self, camera: CameraConfig, aravis: Aravis) -> None:
        self._camera = camera
        self._aravis = aravis
        self._device: int | None = None
        self._stream: int | None = None
        self._buffer: int | None = None
        self._unmet: tuple[Message, ...] = ()
        self._sequence = 0

    def open(self, timeout_s: float) -> None:
        """Finds the camera, applies the settings of rig.toml, and starts its stream. Raises CameraNotFound."""
        self.close()
        try:
            self._device = self._aravis.call("arv_camera_new", self._find().encode())
            self._unmet = self._apply()
            self._start()
        except AravisError as error:
            self.close()
            raise CameraNotFound(self._camera, str(error)) from error

    def configure(self) -> tuple[Message, ...]:
        """Returns one message for each setting that the camera refused. ``open`` has applied the settings, because the
        picture's size cannot change while the stream runs."""
        return self._unmet  # applied before the acquisition started: sizes cannot change after it

    def grab(self, timeout_s: float) -> Arrival:
        """Waits for the next complete frame; frames that lost packets are skipped. Raises GrabTimeout, CameraLost."""
        if self._stream is None:
            raise CameraLost(self._camera, compose("camera-not-open"))
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            buffer = self._aravis.call("arv_stream_timeout_pop_buffer", self._stream, round(left_s * 1e6))
            if not buffer:
                break
            if self._aravis.call("arv_buffer_get_status", buffer) != BUFFER_SUCCESS:
                self._aravis.call("arv_stream_push_buffer", self._stream, buffer)  # lost packets: no frame
                continue
            self._give_back()
            self._buffer = buffer
            self._sequence += 1
            return Arrival(self._stamp_s(buffer), self._sequence)
        raise GrabTimeout(self._camera, timeout_s)

    def retrieve(self) -> ImageRgb:
        """Decodes the frame of the last ``grab``. Raises CameraLost if there is no frame, and DriverError for an
        unknown pixel format."""
        if self._buffer is None:
            raise CameraLost(self._camera, compose("no-frame-grabbed"))
        width = self._aravis.call("arv_buffer_get_image_width", self._buffer)
        height = self._aravis.call("arv_buffer_get_image_height", self._buffer)
        pixel_format = self._aravis.call("arv_buffer_get_image_pixel_format", self._buffer)
        return self._decode(self._aravis.pixels(self._buffer), width, height, pixel_format)

    def trigger(self) -> None:
        """Makes the camera take a picture, if rig.toml sets a software trigger. Raises CameraLost."""
        if self._camera.trigger != "software" or self._device is None:
            return
        try:
            self._aravis.call("arv_camera_software_trigger", self._device)
        except AravisError as error:
            raise CameraLost(self._camera, compose("camera-does-not-release", reason=str(error))) from error

    def close(self) -> None:
        """Stops the stream and releases the camera."""
        device, stream = self._device, self._stream
        self._give_back()
        self._device = self._stream = None
        if device is not None and stream is not None:
            with contextlib.suppress(AravisError):  # a camera whose cable is out cannot be told
                self._aravis.call("arv_camera_stop_acquisition", device)
            self._aravis.release(stream)
        if device is not None:
            self._aravis.release(device)

    def _give_back(self) -> None:
        if self._buffer is not None and self._stream is not None:
            self._aravis.call("arv_stream_push_buffer", self._stream, self._buffer)
        self._buffer = None

    def _find(self) -> str:
        wanted = self._camera.identity
        with _discovery:
            self._aravis.call("arv_update_device_list")
            cameras = []
            for index in range(self._aravis.call("arv_get_n_devices")):
                device_id = self._aravis.call("arv_get_device_id", index)
                serial = self._aravis.call("arv_get_device_serial_nbr", index)
                if wanted in (device_id, serial, self._aravis.call("arv_get_device_physical_id", index)):
                    return device_id
                cameras.append(serial or device_id)
        raise CameraNotFound(self._camera, compose("serial-numbers-found", found=cameras or ["none"]))

    def _apply(self) -> tuple[Message, ...]:
        camera, unmet = self._camera, []
        settings: list[tuple[str, object, list[tuple]]] = []
        if camera.pixel_format is not None:
            text = camera.pixel_format.encode()
            settings.append(("pixel_format", camera.pixel_format, [("set_pixel_format_from_string", text)]))
        if camera.width is not None and camera.height is not None:
            region = ("set_region", 0, 0, camera.width, camera.height)
            settings.append(("width x height", f"{camera.width} x {camera.height}", [region]))
        elif camera.width is not None or camera.height is not None:
            unmet.append(compose("sizes-set-together"))
        if camera.exposure_ms is not None:
            self._switch_off("exposure_time_auto")
            settings.append(("exposure_ms", camera.exposure_ms, [("set_exposure_time", camera.exposure_ms * 1000)]))
        if camera.gain_db is not None:
            self._switch_off("gain_auto")
            settings.append(("gain_db", camera.gain_db, [("set_gain", camera.gain_db)]))
        if camera.white_balance_k is not None:
            unmet.append(compose("no-genicam-white-balance"))
        source = _SOURCES.get(camera.trigger)
        if source is not None:
            settings.append(("trigger", camera.trigger, [("set_trigger", source)]))
        else:
            rate = [] if camera.fps is None else [("set_frame_rate", camera.fps)]
            settings.append(("trigger", camera.trigger, [("clear_triggers",), *rate]))
        for key, value, calls in settings:
            try:
                for name, *arguments in calls:
                    self._aravis.call(f"arv_camera_{name}", self._device, *arguments)
            except AravisError as error:
                unmet.append(compose("setting-not-taken-because", setting=key, value=str(value), reason=str(error)))
        return tuple(unmet)

    def _switch_off(self, automatic: str) -> None:
        with contextlib.suppress(AravisError):  # many cameras have no automatic to switch off
            self._aravis.call(f"arv_camera_set_{automatic}", self._device, AUTO_OFF)

    def _start(self) -> None:
        if self._aravis.call("arv_camera_is_gv_device", self._device):
            # Packet sockets need CAP_NET_RAW and see nothing on the loopback; plain UDP works everywhere.
            self._aravis.call("arv_camera_gv_set_stream_options", self._device, PACKET_SOCKET_DISABLED)
        self._stream = self._aravis.call("arv_camera_create_stream", self._device, None, None)
        payload = self._aravis.call("arv_camera_get_payload", self._device)
        for _ in range(_BUFFERS):
            self._aravis.call(
                "arv_stream_push_buffer", self._stream, self._aravis.call("arv_buffer_new_allocate", payload)
            )
        self._aravis.call("arv_camera_start_acquisition", self._device)

    def _stamp_s(self, buffer: int) -> float:
        """Returns the time (time.monotonic, s) at which Aravis received the buffer on this host."""
        now_s = time.monotonic()
        age_s = (time.time_ns() - self._aravis.call("arv_buffer_get_system_timestamp", buffer)) * 1e-9
        return now_s - age_s if 0 <= age_s < 1.0 else now_s

    def _decode(self, data: UInt8[np.ndarray, " n"], width: int, height: int, pixel_format: int) -> ImageRgb:
        if pixel_format not in _CONVERSIONS:
            raise DriverError(self._camera.name, compose("pixel-format-unread", pixel_format=f"{pixel_format:08X}"))
        channels = pixel_format >> 16 & 0xFF
        if len(data) < width * height * channels // 8:
            raise CameraLost(self._camera, compose("frame-incomplete"))
        shape = (height, width, 3) if channels == 24 else (height, width)
        image = data[: width * height * channels // 8].reshape(shape)
        conversion = _CONVERSIONS[pixel_format]
        return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion), np.uint8)

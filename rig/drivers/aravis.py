"""libaravis-0.8 through ctypes: the few functions that rig.drivers.genicam needs, typed, with GError as an exception.

ctypes rather than PyGObject: one shared library from the distribution is all it asks for, while PyGObject has to be
compiled against the girepository headers in every virtual environment.
Source of the signatures: https://aravisproject.github.io/aravis/aravis-stable/
"""

import ctypes
from ctypes import POINTER, byref, c_bool, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import UInt8

LIBRARY = "libaravis-0.8.so.0"
BUFFER_SUCCESS = 0  # ARV_BUFFER_STATUS_SUCCESS
AUTO_OFF = 0  # ARV_AUTO_OFF
PACKET_SOCKET_DISABLED = 1  # ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED


class AravisError(Exception):
    """Reports that Aravis refused a call; the text is Aravis's."""


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
    """Wraps the library libaravis. ``call`` runs one of its functions and raises AravisError where that reports a
    GError."""

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
        """Calls the library's function ``name`` and returns its result; texts are returned as str.
        Raises AravisError."""
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
        """Gives a reference to a GObject back to the library."""
        self._gobject.g_object_unref(pointer)

    def pixels(self, buffer: int) -> UInt8[np.ndarray, " n"]:
        """Returns a copy of the bytes of the image in a buffer."""
        size = c_size_t()
        data = self._aravis.arv_buffer_get_image_data(buffer, byref(size))
        return np.frombuffer(ctypes.string_at(data, size.value), np.uint8)


@cache
def library() -> Aravis:
    """Returns the library, which is loaded once. Raises OSError where it is not installed."""
    return Aravis()

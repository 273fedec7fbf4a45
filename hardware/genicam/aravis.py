"""ctypes bindings of the library Aravis; its errors become exceptions.

Nothing is loaded before ``library`` is called. Objects are plain pointers; whoever makes one
drops it with ``unref``.
"""

import ctypes
import sys
from ctypes import (
    CDLL,
    POINTER,
    byref,
    c_char_p,
    c_double,
    c_int,
    c_int64,
    c_size_t,
    c_uint,
    c_uint32,
    c_uint64,
    c_void_p,
)
from functools import cache
from typing import Any, Final

from hardware.errors import MissingLibrary

_NAMES: Final = {
    "linux": "libaravis-0.8.so.0",
    "darwin": "libaravis-0.8.0.dylib",
    "win32": "libaravis-0.8-0.dll",
}

SUCCESS: Final = 0
"""Status of a buffer that holds a whole image."""

CONTROL_REGISTER: Final = 0x0A00
"""GigE Vision's control channel privilege; its two lowest bits: somebody controls the camera."""

CONTROL_BITS: Final = 3


_NO_ANSWER: Final = frozenset((2, 4, 5))
"""Of ArvDeviceError: not connected, transfer error, timeout."""


class AravisError(Exception):
    """Error of a failed Aravis call.

    Args:
        message: as Aravis words it.
        unanswered: whether the device did not answer, rather than refuse.
    """

    def __init__(self, message: str, *, unanswered: bool = False) -> None:
        super().__init__(message)
        self.unanswered = unanswered


class _GError(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


_PLAIN: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "arv_device_error_quark": (c_uint32, ()),
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_address": (c_char_p, (c_uint,)),
    "arv_get_device_vendor": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint,)),
    "arv_get_device_protocol": (c_char_p, (c_uint,)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_stream_try_pop_buffer": (c_void_p, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_clear_error": (None, (c_void_p,)),
}
"""Result and arguments of calls that cannot fail."""

_FAILING: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p)),
    "arv_camera_get_payload": (c_uint, (c_void_p,)),
    "arv_camera_start_acquisition": (None, (c_void_p,)),
    "arv_camera_stop_acquisition": (None, (c_void_p,)),
    "arv_camera_set_acquisition_mode": (None, (c_void_p, c_int)),
    "arv_camera_set_pixel_format_from_string": (None, (c_void_p, c_char_p)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p,)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p)),
    "arv_camera_set_integer": (None, (c_void_p, c_char_p, c_int64)),
    "arv_camera_set_float": (None, (c_void_p, c_char_p, c_double)),
    "arv_camera_set_boolean": (None, (c_void_p, c_char_p, c_int)),
    "arv_camera_get_string": (c_char_p, (c_void_p, c_char_p)),
    "arv_camera_get_integer": (c_int64, (c_void_p, c_char_p)),
    "arv_camera_get_float": (c_double, (c_void_p, c_char_p)),
    "arv_camera_execute_command": (None, (c_void_p, c_char_p)),
    "arv_device_read_register": (c_int, (c_void_p, c_uint64, POINTER(c_uint32))),
}
"""The same of calls whose last argument, added here, takes an error."""


class Aravis:
    """The loaded library; each function under its C name without ``arv_``."""

    def __init__(self, loaded: CDLL) -> None:
        self._calls: dict[str, Any] = {}
        for name, (result, arguments) in _PLAIN.items():
            self._calls[name] = _declared(loaded, name, result, arguments)
        for name, (result, arguments) in _FAILING.items():
            call = _declared(loaded, name, result, (*arguments, POINTER(POINTER(_GError))))
            self._calls[name] = self._raising(call)

    def __getattr__(self, name: str) -> Any:
        """Return the function ``arv_NAME``."""
        try:
            return self._calls[f"arv_{name}"]
        except KeyError:
            raise AttributeError(f"arv_{name} is not declared here") from None

    def unref(self, pointer: int) -> None:
        """Release a reference to a GObject."""
        self._calls["g_object_unref"](pointer)

    def _raising(self, call: Any) -> Any:
        clear, domain = self._calls["g_clear_error"], self._calls["arv_device_error_quark"]

        def raising(*arguments: Any) -> Any:
            error = POINTER(_GError)()
            result = call(*arguments, byref(error))
            if error:
                said = error.contents
                message = (said.message or b"no reason given").decode(errors="replace")
                unanswered = said.domain == domain() and said.code in _NO_ANSWER
                clear(byref(error))
                raise AravisError(message, unanswered=unanswered)
            return result

        return raising


def _declared(loaded: CDLL, name: str, result: Any, arguments: tuple[Any, ...]) -> Any:
    call = loaded[name]
    call.restype, call.argtypes = result, arguments
    return call


@cache
def library() -> Aravis:
    """Return the Aravis library, loaded on the first call.

    Raises:
        MissingLibrary: it is not installed, or too old.
    """
    name = _NAMES.get(sys.platform, _NAMES["linux"])
    try:
        return Aravis(CDLL(name))
    except (OSError, AttributeError) as error:
        raise MissingLibrary(
            f"GenICam cameras need the library Aravis 0.8, and loading {name} failed: {error}; on "
            "Debian and Ubuntu: apt-get install libaravis-0.8-0",
            library=name,
        ) from error

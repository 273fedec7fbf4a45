"""GenICam cameras: discovery, configuration, buffer stream and presence check of one."""

import time
from contextlib import suppress
from ctypes import byref, c_size_t, c_uint32, string_at
from dataclasses import dataclass
from threading import Thread
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.errors import DeviceNotConnected
from hardware.genicam.aravis import (
    CONTROL_BITS,
    CONTROL_REGISTER,
    SUCCESS,
    Aravis,
    AravisError,
    library,
)
from hardware.genicam.pixel_formats import check_width, unpack_counts
from hardware.genicam.settings import GenicamCamera, GenicamSettings
from hardware.genicam.timestamps import BufferTimestamps

_CONTINUOUS: Final = 0
_MAX_BUFFERS: Final = 128
_MIN_BUFFERS: Final = 8
_MEMORY_BYTES: Final = 64 * 2**20
_EXPOSURES: Final = ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw")
_LINE_RATES: Final = ("AcquisitionLineRate", "AcquisitionLineRateAbs")
_FRAME_RATES: Final = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")


@dataclass(frozen=True, eq=False, slots=True)
class Buffer:
    """One image buffer of a camera.

    Args:
        number: the camera's frame number.
        device_ns: start of the first exposure on the camera's clock [ns].
        arrival_ns: arrival on the host's monotonic clock [ns].
        lines: counts, uint16, shape (lines, pixels); None: parts of it were lost.
        bytes: size of the buffer.
    """

    number: int
    device_ns: int
    arrival_ns: int
    lines: NDArray[np.uint16] | None
    bytes: int


class Camera:
    """A camera that this program controls.

    Args:
        which: the camera.
        settings: of the device.

    Raises:
        DeviceNotConnected: it is not there, or another program controls it.
        InvalidParameter: it cannot be set so.
        MissingLibrary: Aravis is not installed.
    """

    def __init__(self, which: GenicamCamera, settings: GenicamSettings) -> None:
        self._camera_settings = which
        self._settings = settings
        self._aravis: Aravis = library()
        self._stream: int | None = None
        self._arrivals = BufferTimestamps()
        try:
            self._camera: int | None = self._aravis.camera_new(which.camera.encode())
        except AravisError as error:
            raise self._unavailable(str(error)) from error
        self._gige = bool(self._aravis.camera_is_gv_device(self._camera))
        try:
            if not self.is_present():
                raise self._unavailable("another program controls it, or it went away")
            self._set_up()
            self.width: int = self._get("integer", "Width")
            check_width(settings.pixel_format, self.width)
            self.exposure_ns = round(self._first_float(_EXPOSURES) * 1e3)
            self.line_rate_hz = self._rate()
        except DeviceNotConnected:
            # In a thread: letting go what does not answer takes seconds.
            Thread(target=self.close, name="genicam-close", daemon=True).start()
            raise
        except BaseException:
            self.close()
            raise

    def start(self) -> None:
        """Start the acquisition; raises DeviceNotConnected where that fails."""
        call = self._aravis
        try:
            self._stream = call.camera_create_stream(self._camera, None, None)
            size = call.camera_get_payload(self._camera)
            count = min(_MAX_BUFFERS, max(_MIN_BUFFERS, _MEMORY_BYTES // max(1, size)))
            for _ in range(count):
                call.stream_push_buffer(self._stream, call.buffer_new_allocate(size))
            call.camera_start_acquisition(self._camera)
        except AravisError as error:
            raise self._unavailable(str(error)) from error

    def take(self, wait_us: int) -> Buffer | None:
        """Return the next buffer; None: none arrived within that time."""
        call = self._aravis
        stream = self._stream
        assert stream is not None
        before_ns = time.monotonic_ns()
        if wait_us:
            pointer = call.stream_timeout_pop_buffer(stream, wait_us)
        else:
            pointer = call.stream_try_pop_buffer(stream)
        if not pointer:
            self._arrivals.empty(before_ns)
            return None
        try:
            return self._read(pointer)
        finally:
            call.stream_push_buffer(stream, pointer)

    def is_present(self) -> bool:
        """Whether it answers and this program still controls it; may take 3 s if not."""
        call = self._aravis
        try:
            if not self._gige:
                call.camera_get_integer(self._camera, b"Width")
                return True
            device = call.camera_get_device(self._camera)
            value = c_uint32()
            call.device_read_register(device, CONTROL_REGISTER, byref(value))
            controlled = bool(value.value & CONTROL_BITS)
            return controlled and bool(call.gv_device_is_controller(device))
        except AravisError:
            return False

    def close(self) -> None:
        """Release the camera; takes seconds when it is no longer present."""
        camera, self._camera = self._camera, None
        stream, self._stream = self._stream, None
        if stream is not None:
            with suppress(AravisError):  # it may have gone away
                self._aravis.camera_stop_acquisition(camera)
            self._aravis.unref(stream)
        if camera is not None:
            self._aravis.unref(camera)

    def _read(self, pointer: int) -> Buffer:
        call = self._aravis
        size = c_size_t()
        data = call.buffer_get_data(pointer, byref(size))
        lines = None
        if call.buffer_get_status(pointer) == SUCCESS:
            width = call.buffer_get_image_width(pointer)
            height = call.buffer_get_image_height(pointer)
            if (width, height) == (self.width, self._settings.lines_per_buffer):
                raw = string_at(data, size.value)
                lines = unpack_counts(raw, self._settings.pixel_format, width, height)
        return Buffer(
            number=call.buffer_get_frame_id(pointer),
            device_ns=call.buffer_get_timestamp(pointer),
            arrival_ns=self._arrivals.of(call.buffer_get_system_timestamp(pointer)),
            lines=lines,
            bytes=size.value,
        )

    def _set_up(self) -> None:
        settings, call = self._settings, self._aravis
        self._try(
            "pixel_format",
            settings.pixel_format,
            lambda: call.camera_set_pixel_format_from_string(
                self._camera, settings.pixel_format.encode()
            ),
        )
        if settings.width is not None:
            if self._has("OffsetX"):  # first out of the way: width and offset limit one another
                self._set("offset_x", "OffsetX", 0)
            self._set("width", "Width", settings.width)
            if settings.offset_x:
                self._set("offset_x", "OffsetX", settings.offset_x)
        self._set("lines_per_buffer", "Height", settings.lines_per_buffer)
        self._try(
            "acquisition mode",
            "Continuous",
            lambda: call.camera_set_acquisition_mode(self._camera, _CONTINUOUS),
        )
        if settings.line_rate_hz is not None:
            line_rate = next((name for name in _LINE_RATES if self._has(name)), None)
            if line_rate is not None:
                self._set("line_rate_hz", line_rate, settings.line_rate_hz)
            else:
                frame_rate = next((n for n in _FRAME_RATES if self._has(n)), _FRAME_RATES[0])
                rate = settings.line_rate_hz / settings.lines_per_buffer
                self._set("line_rate_hz", frame_rate, rate)
        if settings.exposure_us is not None:
            exposure_us = settings.exposure_us
            self._try(
                "exposure_us",
                exposure_us,
                lambda: call.camera_set_exposure_time(self._camera, exposure_us),
            )
        for feature in settings.features:
            self._set("feature", feature.name, feature.value)

    def _set(self, what: str, name: str, value: bool | int | float | str) -> None:
        call, camera = self._aravis, self._camera
        encoded = name.encode()

        def setting() -> None:
            if isinstance(value, bool):
                call.camera_set_boolean(camera, encoded, value)
            elif isinstance(value, str):
                call.camera_set_string(camera, encoded, value.encode())
            elif isinstance(value, int):
                try:
                    call.camera_set_integer(camera, encoded, value)
                except AravisError as error:  # a whole number for a feature that takes any
                    if error.unanswered:
                        raise
                    call.camera_set_float(camera, encoded, float(value))
            else:
                call.camera_set_float(camera, encoded, value)

        self._try(what, value, setting, name)

    def _try(self, what: str, value: object, setting: Any, name: str | None = None) -> None:
        try:
            setting()
        except AravisError as error:
            if error.unanswered or not self.is_present():
                raise self._unavailable(f"it went away while it was set up: {error}") from error
            feature = f" (its feature {name})" if name is not None else ""
            raise InvalidParameter(
                f"{self._camera_settings}: {what}{feature} cannot be {value!r}: {error}",
                **{what: value},
            ) from error

    def _has(self, name: str) -> bool:
        try:
            return bool(self._aravis.camera_is_feature_available(self._camera, name.encode()))
        except AravisError as error:
            if error.unanswered:
                raise self._unavailable(f"whether it has {name} cannot be read: {error}") from error
            return False

    def _get(self, kind: str, name: str) -> Any:
        try:
            return getattr(self._aravis, f"camera_get_{kind}")(self._camera, name.encode())
        except AravisError as error:
            raise self._unavailable(f"its {name} cannot be read: {error}") from error

    def _first_float(self, names: tuple[str, ...]) -> float:
        """Return the value of the first of these features that the camera has; 0: none."""
        for name in names:
            if self._has(name):
                try:
                    return float(self._aravis.camera_get_float(self._camera, name.encode()))
                except AravisError as error:
                    if error.unanswered:
                        raise self._unavailable(f"its {name} cannot be read: {error}") from error
                    return float(self._get("integer", name))
        return 0.0

    def _rate(self) -> float:
        """Return the camera's exposure rate [Hz]; 0: it states none."""
        line_rate_hz = self._first_float(_LINE_RATES)
        if line_rate_hz > 0.0:
            return line_rate_hz
        return self._first_float(_FRAME_RATES) * self._settings.lines_per_buffer

    def _unavailable(self, why: str) -> DeviceNotConnected:
        return DeviceNotConnected(
            f"{self._camera_settings} cannot be used: {why}; check its cable, power and address, "
            "and that no other program has it open",
            camera=self._camera_settings.camera,
        )


@dataclass(frozen=True)
class DiscoveredCamera:
    """A discovered camera: identifier, address, vendor, model, serial number, protocol."""

    camera: str
    address: str
    vendor: str
    model: str
    serial_number: str
    protocol: str


def cameras() -> list[DiscoveredCamera]:
    """Return the cameras that answer within a second.

    Raises:
        MissingLibrary: Aravis is not installed.
    """
    aravis = library()
    aravis.update_device_list()
    getters = (
        aravis.get_device_id,
        aravis.get_device_address,
        aravis.get_device_vendor,
        aravis.get_device_model,
        aravis.get_device_serial_nbr,
        aravis.get_device_protocol,
    )
    return [
        DiscoveredCamera(*((ask(index) or b"").decode(errors="replace") for ask in getters))
        for index in range(aravis.get_n_devices())
    ]

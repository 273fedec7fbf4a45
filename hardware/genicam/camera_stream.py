"""Scans of one camera with continuous numbers and times, over disconnections."""

import time
from collections.abc import Iterator
from threading import Thread
from typing import Final

from compute.errors import InvalidParameter
from hardware.errors import DeviceChanged, DeviceNotConnected
from hardware.genicam.camera import Buffer, Camera
from hardware.genicam.frame_sync import CameraScan
from hardware.genicam.settings import GenicamCamera, GenicamSettings
from hardware.genicam.timestamps import FrameCounter, ScanTimestamps

RETRY_S: Final = (0.1, 0.25, 0.5, 1.0, 2.0)
"""Delays before the attempts to open a lost camera; the last one repeats."""

REFUSALS: Final = 5
"""Tolerated refusals of its settings in a row: a camera that returns may still be starting."""


class CameraStream:
    """A camera and its scans, connected or not.

    Args:
        which: the camera.
        settings: of the device.
    """

    def __init__(self, which: GenicamCamera, settings: GenicamSettings) -> None:
        self.frame_counter = FrameCounter()
        self.timestamps = ScanTimestamps()
        self.reason = ""
        """Why it is not connected."""
        self._camera_settings = which
        self._settings = settings
        self._camera: Camera | None = None
        self._width = 0
        self._period_ns = 0.0
        self._last: Buffer | None = None
        self._closing: Thread | None = None
        self._attempts = 0
        self._refusals = 0
        self._next_try_s = 0.0

    @property
    def name(self) -> str:
        """Description of the camera for messages."""
        return f"{self._camera_settings},"

    @property
    def connected(self) -> bool:
        """Whether the camera is connected."""
        return self._camera is not None

    @property
    def line_rate_hz(self) -> float:
        """The camera's exposure rate [Hz]; 0: it states none."""
        return self._camera.line_rate_hz if self._camera is not None else 0.0

    @property
    def width(self) -> int:
        """Pixels of a scan; known after the first ``open``."""
        return self._width

    def open(self) -> None:
        """Open and configure the camera; raises what ``Camera`` raises."""
        self._camera = Camera(self._camera_settings, self._settings)
        if not self._width:  # the first time; later the times go on
            self.timestamps = ScanTimestamps(self._camera.exposure_ns)
        self._width = self._camera.width
        rate_hz = self._camera.line_rate_hz
        self._period_ns = 1e9 / rate_hz if rate_hz > 0.0 else 0.0

    def start(self) -> None:
        """Start the acquisition; raises DeviceNotConnected."""
        assert self._camera is not None
        self._camera.start()

    def reconnect(self) -> bool:
        """Try to reopen a lost camera once its delay has passed; return whether it is back.

        Raises:
            DeviceChanged: its width has changed.
            InvalidParameter: it has refused its settings more than REFUSALS times.
        """
        if time.monotonic() < self._next_try_s or self._is_closing():
            return False
        width = self._width
        try:
            self.open()
            if self._width != width:
                raise DeviceChanged(
                    f'sensor "{self._camera_settings.name}" had {width} pixels and has '
                    f"{self._width} since its camera came back; set its width, or "
                    "start the device again",
                    sensor=self._camera_settings.name,
                )
            self.start()
        except DeviceNotConnected as error:
            self.mark_lost(error.detail)
            return False
        except InvalidParameter as error:
            self._refusals += 1
            if self._refusals > REFUSALS:
                raise
            self.mark_lost(error.detail)
            return False
        self._attempts = self._refusals = 0
        return True

    def mark_lost(self, reason: str) -> None:
        """Mark the camera as lost; ``reconnect`` tries to reopen it."""
        self.reason = reason
        self.frame_counter.restart()
        self._last = None
        self._next_try_s = time.monotonic() + RETRY_S[min(self._attempts, len(RETRY_S) - 1)]
        self._attempts += 1
        self.close()

    def is_present(self) -> bool:
        """Whether the camera answers; may take seconds if not."""
        return self._camera is not None and self._camera.is_present()

    def take(self, wait_us: int) -> Buffer | None:
        """Return the camera's next buffer; None: none arrived within that time."""
        return self._camera.take(wait_us) if self._camera is not None else None

    def lines(self, buffer: Buffer) -> Iterator[CameraScan]:
        """Yield the scans of a complete buffer."""
        assert buffer.lines is not None
        rows = len(buffer.lines)
        first = self.frame_counter.next(buffer.number) * rows
        self._measure_period(buffer, rows)
        self.timestamps.buffer(buffer.device_ns, buffer.arrival_ns)
        half_exposure_ns = self._camera.exposure_ns // 2 if self._camera is not None else 0
        restarts = self.frame_counter.restarts + self.timestamps.restarts
        for row, counts in enumerate(buffer.lines):
            device_ns, monotonic_ns = self.timestamps.line(
                half_exposure_ns + round(row * self._period_ns)
            )
            yield CameraScan(first + row, device_ns, monotonic_ns, counts, restarts)

    def _measure_period(self, buffer: Buffer, rows: int) -> None:
        """Estimate the line period from two buffers, where the camera states no rate."""
        last, self._last = self._last, buffer
        stated = self._camera is not None and self._camera.line_rate_hz > 0.0
        if stated or last is None or buffer.number != last.number + 1:
            return
        self._period_ns = max(0, buffer.device_ns - last.device_ns) / rows

    def close(self) -> None:
        """Release the camera in a thread: an absent one takes seconds."""
        camera, self._camera = self._camera, None
        if camera is not None:
            self._closing = Thread(target=camera.close, name="genicam-close", daemon=True)
            self._closing.start()

    def wait_closed(self, timeout_s: float) -> None:
        """Wait at most ``timeout_s`` until the camera is released."""
        if self._closing is not None:
            self._closing.join(timeout_s)

    def _is_closing(self) -> bool:
        return self._closing is not None and self._closing.is_alive()

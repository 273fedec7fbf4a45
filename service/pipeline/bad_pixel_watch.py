"""BadPixelWatch: looks for bad pixels in samples of a running device's frames."""

import logging
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from math import sqrt
from typing import Final

import numpy as np

from compute.signal.bad_pixel_monitor import MIN_SCANS, BadPixelMonitor
from compute.signal.radiometric_calibration import BadPixel
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import KINDS, LiveBadPixel

_log = logging.getLogger(__name__)

SAMPLE_INTERVAL_S: Final = 0.05
"""Time between two frames that are looked at: with four sensors of 2048 pixels they cost the
compute thread a thousandth of its time."""
MAX_SCANS: Final = 24 * MIN_SCANS
"""A sensor's extremes begin anew after so many frames, five minutes: a pixel may become hot later.
What was found stays."""


class BadPixelWatch:
    """Takes a frame now and then, and names bad pixels; it belongs to one run of a device.

    Sensors are judged in turns, one in a call, so that no batch waits for long.

    Args:
        device_id: for the log.
        description: the device.
    """

    def __init__(self, device_id: str, description: DeviceDescription) -> None:
        self._device_id = device_id
        self._names = [sensor.name for sensor in description.sensors]
        self._pixels = description.sensors[0].pixels
        noise = description.read_noise_electrons / description.electrons_per_count
        self._sigma_counts = sqrt(noise**2 + 1.0 / 12.0)
        self._full_scale = 2**description.bits - 1
        self._line_sigma_px = description.line_sigma_px
        self._monitors = [BadPixelMonitor(self._pixels) for _ in self._names]
        self._judged = [0] * len(self._names)
        """Scans of each sensor when it was judged last."""
        self._bad_pixels: dict[tuple[int, int], LiveBadPixel] = {}
        self.due_s = 0.0
        """When the next frame is to be looked at, by ``time.monotonic`` [s]."""
        self._samples = 0
        self.busy_s = 0.0
        """Time that it has taken so far [s]."""

    @property
    def found(self) -> tuple[LiveBadPixel, ...]:
        """Bad pixels so far, by sensor and pixel."""
        return tuple(self._bad_pixels[key] for key in sorted(self._bad_pixels))

    def take(self, frames: Sequence[LineFrame]) -> bool:
        """Look at a frame of a batch; return whether a bad pixel is new."""
        begin = time.perf_counter()
        self.due_s = time.monotonic() + SAMPLE_INTERVAL_S
        self._samples += 1
        # Not always the last: batches may follow the strobe.
        frame = frames[self._samples % len(frames)]
        for monitor, scan in zip(self._monitors, frame.lines, strict=True):
            monitor.add(scan[None])
        new = self._judge_next(frame.exposure_host_ns)
        self.busy_s += time.perf_counter() - begin
        return new

    def _judge_next(self, exposure_ns: int) -> bool:
        """Test the next sensor that has enough new scans; return whether a bad pixel is new."""
        for number, monitor in enumerate(self._monitors):
            if monitor.scans - self._judged[number] < MIN_SCANS:
                continue
            self._judged[number] = monitor.scans
            flags = monitor.find(self._sigma_counts, self._full_scale, self._line_sigma_px)
            if monitor.scans >= MAX_SCANS:
                self._monitors[number] = BadPixelMonitor(self._pixels)
                self._judged[number] = 0
            since = datetime.fromtimestamp(exposure_ns * 1e-9, UTC)
            new = [
                LiveBadPixel(
                    self._names[number], int(pixel), KINDS[BadPixel(int(flags[pixel]))], since
                )
                for pixel in np.flatnonzero(flags)
                if (number, int(pixel)) not in self._bad_pixels
            ]
            self._bad_pixels |= {(number, one.pixel): one for one in new}
            if new:
                _log.warning(
                    "device %s: sensor %s has bad pixels, which are masked from now on: %s",
                    self._device_id,
                    self._names[number],
                    ", ".join(f"{one.pixel} ({one.kind})" for one in new),
                    extra={"device": self._device_id},
                )
            return bool(new)
        return False

"""LiveManager: owns every running device's threads; what the REST layer talks to."""

from dataclasses import dataclass
from typing import Literal

from compute.calibration.result import Calibration
from hardware.driver import DeviceDescription, Driver

DeviceState = Literal["stopped", "running", "ended", "failed"]


@dataclass(frozen=True)
class DeviceStatus:
    """What a device is doing, and what was lost where since it was started.

    Args:
        state: running, stopped by request, ended by itself (a recording), or failed.
        reason: why it failed, or ended; None otherwise.
        calibration_id: the calibration that points are reconstructed with; None: peaks only.
        frames: frames received from the driver.
        frames_lost_device: exposures missing in the device's sequence numbers.
        frames_dropped_ring: frames dropped because the compute thread did not keep up.
        frames_processed: frames that were published.
        subscribers: connected streams.
    """

    state: DeviceState
    reason: str | None = None
    calibration_id: str | None = None
    frames: int = 0
    frames_lost_device: int = 0
    frames_dropped_ring: int = 0
    frames_processed: int = 0
    subscribers: int = 0


class LiveManager:
    """Starts and stops devices; all methods may be called from any thread."""

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        calibration_id: str | None = None,
        calibration: Calibration | None = None,
    ) -> DeviceDescription:
        """Open the driver and start its reader; raises LumilineError when it cannot be opened.

        A device that is running is stopped first.
        """
        raise NotImplementedError

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        raise NotImplementedError

    def set_calibration(
        self, device_id: str, calibration_id: str | None, calibration: Calibration | None
    ) -> None:
        """Switch the calibration between two frames; nothing happens when it is not running."""
        raise NotImplementedError

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop all devices and the compute thread."""
        raise NotImplementedError

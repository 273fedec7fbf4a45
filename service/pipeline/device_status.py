"""DeviceStatus: what a device is doing, and how many frames it has lost."""

from dataclasses import dataclass
from typing import Literal

from hardware.link import LinkState
from service.pipeline.active_calibration import LiveBadPixel

DeviceState = Literal["stopped", "starting", "running", "disconnected", "ended", "failed"]


@dataclass(frozen=True)
class DeviceStatus:
    """State of a device, and the frames that were lost since it was started, by place.

    Args:
        state: starting (its driver is being opened), running, disconnected (its device is not
            there, and is tried again until it is), stopped by request, ended by itself (a
            recording), or failed.
        reason: why it failed, ended or is disconnected, or what is wrong with its link, or, while
            it runs, what its driver does before the first frame, why its markers are not found
            (three sensors and several lit together), or that its calibration is nominal.
        calibration_id: the calibration that points are reconstructed with; None: peaks only.
        table_id: the correction table that readings are corrected by; None: they are not.
        frames_received: frames received from the driver.
        frames_lost: exposures missing in the device's sequence numbers.
        frames_dropped_compute: frames dropped because the compute thread did not keep up.
        frames_processed: frames that were published.
        subscribers: connected streams.
        link: of a device that can be unplugged, how its link stands; None of others.
        frames_not_tracked: frames whose points were made, but in which markers and tools were not
            tracked, because the compute thread did not keep up.
        radiometric_id: the radiometric calibration that peaks are found with; None: none.
        bad_pixels: pixels that the frames have shown to be bad since the start; no measurement
            uses them.
    """

    state: DeviceState
    reason: str | None = None
    calibration_id: str | None = None
    table_id: str | None = None
    frames_received: int = 0
    frames_lost: int = 0
    frames_dropped_compute: int = 0
    frames_processed: int = 0
    subscribers: int = 0
    link: LinkState | None = None
    frames_not_tracked: int = 0
    radiometric_id: str | None = None
    bad_pixels: tuple[LiveBadPixel, ...] = ()

"""Whether a device that came back is the one that it was."""

from typing import Final

from hardware.errors import DeviceChanged
from hardware.serial.messages import Description

_VALUES: Final = (
    ("pitch_um", "pixel pitch", "um"),
    ("bits", "conversion", "bits"),
    ("electrons_per_count", "gain", "electrons per count"),
    ("read_noise_electrons", "read noise", "electrons"),
    ("offset_counts", "offset", "counts"),
    ("line_sigma_px", "line width", "px"),
)
"""What peaks and calibrations are computed with; its clock, delay and rate may be others."""


def check_identity(before: Description, now: Description) -> None:
    """Raise DeviceChanged when the sensors, or what is computed with, are others than before."""
    if (now.sensors, now.pixels) != (before.sensors, before.pixels):
        raise DeviceChanged(
            f"{now.name} came back with the sensors {', '.join(now.sensors)} of {now.pixels} px; "
            f"before there were {', '.join(before.sensors)} of {before.pixels} px; start the "
            "device anew",
        )
    for name, words, unit in _VALUES:
        old, new = getattr(before, name), getattr(now, name)
        if old != new:
            raise DeviceChanged(
                f"{now.name} came back with the {words} {new:g} {unit}; before it was {old:g} "
                f"{unit}; start the device anew, and see whether its calibration still holds",
            )

"""Parses and validates the device description stored in a recording (untrusted input)."""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Final

from pydantic import TypeAdapter, ValidationError

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription, PeakMethod


@dataclass(frozen=True)
class _StoredDescription(DeviceDescription):
    """A stored description; old recordings name no method of peak detection."""

    peaks: PeakMethod = "centroid"


_DESCRIPTION = TypeAdapter(_StoredDescription)

_MAX_HZ: Final = 1e6
_MAX_UM: Final = 1000.0
_FULL: Final = 2**16 - 1


def read_description(text: str) -> DeviceDescription:
    """Return the device description in a recording's JSON.

    Raises:
        InvalidParameter: it is not a description, or an unusable one; the message continues a
            sentence that begins with the file's name.
    """
    try:
        description = DeviceDescription(**vars(_DESCRIPTION.validate_json(text)))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the whole"
        raise InvalidParameter(
            f"has an unusable description of the device: {where}: {first['msg']}"
        ) from error
    _check_values(description)
    return description


def _check_values(description: DeviceDescription) -> None:
    """Check the ranges of the description's values; NaN and infinities are invalid."""
    rate, gain = description.frame_rate_hz, description.electrons_per_count
    noise, offset = description.read_noise_electrons, description.offset_counts
    names = Counter(sensor.name for sensor in description.sensors)
    checks = [
        ("frame_rate_hz", rate, 0 <= rate <= _MAX_HZ, f"0 (not known) to {_MAX_HZ:g}"),
        ("bits", description.bits, 1 <= description.bits <= 16, "1 to 16"),
        ("electrons_per_count", gain, 0 < gain < math.inf, "positive"),
        ("read_noise_electrons", noise, 0 <= noise < math.inf, "0 or more"),
        ("offset_counts", offset, abs(offset) <= _FULL, f"within -{_FULL} to {_FULL}"),
        ("markers", description.markers, description.markers >= 0, "0 or more"),
        *(
            ("a sensor's name", name, 1 <= len(name) <= 64 and "\0" not in name,
             "1 to 64 characters without NUL")
            for name in names
        ),
        *(
            ("a sensor's name", name, count == 1, "a name of its own")
            for name, count in names.items()
        ),
        *(
            ("pitch_um", sensor.pitch_um, 0 < sensor.pitch_um <= _MAX_UM,
             f"positive, at most {_MAX_UM:g}")
            for sensor in description.sensors
        ),
    ]  # fmt: skip
    for name, value, good, right in checks:
        if not good:
            raise InvalidParameter(
                f"describes an unusable device: {name} is {value!r:.80}; it must be {right}"
            )

"""Whether sensors are those of a device as it is now: their names, pixels and order."""

from collections.abc import Sequence
from typing import Protocol

from hardware.driver import SensorDescription
from service.problems.errors import SensorsChanged


class _Sensor(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def pixels(self) -> int: ...


def sensors_match(one: Sequence[_Sensor], other: Sequence[_Sensor]) -> bool:
    """Whether two lists are of the same sensors: readings and models go by position."""
    return _layout(one) == _layout(other)


def check_sensors(
    device_id: str, now: Sequence[SensorDescription], made: Sequence[_Sensor]
) -> None:
    """Check that a calibration is of the device's sensors.

    Args:
        device_id: the device.
        now: its sensors.
        made: the sensors, or their models, that the calibration was made for.

    Raises:
        SensorsChanged: a name, a number of pixels or the order differs.
    """
    if not sensors_match(now, made):
        raise SensorsChanged(
            f'device "{device_id}" has the sensors {listed(now)}; the calibration was made for '
            f"{listed(made)}; calibrate the sensors that the device has now",
            device=device_id,
        )


def _layout(sensors: Sequence[_Sensor]) -> list[tuple[str, int]]:
    return [(sensor.name, sensor.pixels) for sensor in sensors]


def listed(sensors: Sequence[_Sensor]) -> str:
    """Return sensors in words."""
    return ", ".join(f'"{name}" ({pixels} px)' for name, pixels in _layout(sensors))

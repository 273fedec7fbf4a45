"""Line sensors in requests, and the check that sensors are those of a device."""

from collections.abc import Sequence
from typing import Annotated, Protocol

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked_dataclass

from hardware.driver import SensorDescription
from service.api.base_models import Name
from service.problems.errors import SensorsChanged


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Sensor(SensorDescription):
    """One line sensor: name, number of pixels, pixel pitch [um]."""

    name: Name
    pixels: Annotated[int, Field(ge=8, le=65536)]
    pitch_um: Annotated[float, Field(gt=0, le=1000, description="Pixel pitch [um].")]


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
    """Return the sensors' names and pixel counts as text for messages."""
    return ", ".join(f'"{name}" ({pixels} px)' for name, pixels in _layout(sensors))

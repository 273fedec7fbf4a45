"""Points with readings by name, as arrays in the order of the device's sensors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorGeometry
from compute.errors import DuplicatePoint, InvalidParameter, ReadingOutsideSensor, UnknownSensor
from hardware.driver import SensorDescription
from service.api.calibrations.schema import Reading


class ObservedPoint(Protocol):
    """A named point with readings by sensor."""

    @property
    def name(self) -> str:
        """The point's name."""

    @property
    def readings(self) -> dict[str, float | Reading]:
        """Readings by the sensors' names."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Readings and standard deviations, shape (N, S) [px]; NaN where not given."""

    readings_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]

    def all_or_no_sigma(self) -> NDArray[np.float64] | None:
        """Return the deviations, None when none is given.

        Raises:
            InvalidParameter: some readings have one and some have not.
        """
        seen = np.isfinite(self.readings_px)
        given = np.isfinite(self.sigma_px)
        if not given.any():
            return None
        if (seen & ~given).any():
            raise InvalidParameter(
                f"{int(given.sum())} of {int(seen.sum())} readings have a standard deviation; "
                "a calibration needs it for all readings, or for none"
            )
        return self.sigma_px


def observations(
    points: Sequence[ObservedPoint], sensors: Sequence[SensorDescription]
) -> Observations:
    """Sort readings by sensor.

    Raises:
        DuplicatePoint: two points have one name.
        UnknownSensor: a reading's sensor is not one of the device's.
        ReadingOutsideSensor: a reading lies outside its sensor's pixels.
    """
    columns = {sensor.name: index for index, sensor in enumerate(sensors)}
    readings = np.full((len(points), len(sensors)), np.nan)
    sigma = np.full_like(readings, np.nan)
    names: dict[str, int] = {}
    for row, point in enumerate(points):
        if point.name in names:
            raise DuplicatePoint(
                f'points {names[point.name] + 1} and {row + 1} are both called "{point.name}"; '
                "give each point once, under its own name",
                point=point.name,
            )
        names[point.name] = row
        for name, reading in point.readings.items():
            if name not in columns:
                raise UnknownSensor(
                    f'point "{point.name}" has a reading of sensor "{name}", which the device '
                    f"does not have; its sensors are {', '.join(columns)}",
                    point=point.name,
                    sensor=name,
                )
            value = reading.position_px if isinstance(reading, Reading) else reading
            _check_inside(value, sensors[columns[name]], point.name)
            readings[row, columns[name]] = value
            if isinstance(reading, Reading):
                sigma[row, columns[name]] = reading.sigma_px
    return Observations(readings, sigma)


def _check_inside(value_px: float, sensor: SensorDescription, point: str) -> None:
    if not -0.5 <= value_px <= sensor.pixels - 0.5:
        raise ReadingOutsideSensor(
            f'the reading {value_px:g} px of point "{point}" lies outside sensor '
            f'"{sensor.name}", whose {sensor.pixels} pixels reach from -0.5 to '
            f"{sensor.pixels - 0.5:g} px",
            point=point,
            sensor=sensor.name,
            reading_px=value_px,
        )


def geometry(sensors: Sequence[SensorDescription]) -> list[SensorGeometry]:
    """Return what the computation needs to know of the sensors."""
    return [SensorGeometry(sensor.name, sensor.pixels, sensor.pitch_um) for sensor in sensors]

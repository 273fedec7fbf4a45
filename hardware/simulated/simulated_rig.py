"""The simulated sensor bar: four line sensors aimed at one working volume."""

from functools import cache
from math import sqrt
from typing import Final

from compute.optics.sensor_placement import PlacedSensor, SensorModel, Vector3, place_sensor

PIXELS: Final = 2048
PITCH_UM: Final = 12.0  # 2048 pixels on 24.58 mm, section 5.2
PRINCIPAL_DISTANCE_MM: Final = 37.0  # Test 5.2

WORKING_CENTRE_MM: Final[Vector3] = (0.0, 0.0, 1500.0)
"""Middle of the working volume, in front of the bar; all four sensors are aimed at it."""

_DIAGONAL: Final = sqrt(0.5)
# Lens positions of Table 5.10 less their mean height, and the directions measured there: one
# vertical, one horizontal, two diagonal. X along the bar, Y up, Z towards the working volume.
_SENSORS: Final[tuple[tuple[str, Vector3, Vector3], ...]] = (
    ("vertical", (250.0, -86.0, 0.0), (0.0, 1.0, 0.0)),
    ("horizontal", (-250.0, -86.0, 0.0), (1.0, 0.0, 0.0)),
    ("diagonal-rising", (291.0, 86.0, 0.0), (_DIAGONAL, _DIAGONAL, 0.0)),
    ("diagonal-falling", (-291.0, 86.0, 0.0), (_DIAGONAL, -_DIAGONAL, 0.0)),
)


@cache
def simulated_rig() -> tuple[PlacedSensor, ...]:
    """Return the four placed sensors in the device's sensor order."""
    return tuple(
        place_sensor(
            name,
            lens_position_mm=position,
            aim_mm=WORKING_CENTRE_MM,
            measured_direction=direction,
            principal_distance_mm=PRINCIPAL_DISTANCE_MM,
            pixels=PIXELS,
            pitch_um=PITCH_UM,
        )
        for name, position, direction in _SENSORS
    )


def simulated_sensor_models() -> tuple[SensorModel, ...]:
    """Return the true camera models of the simulated device, in its sensor order."""
    return tuple(sensor.model for sensor in simulated_rig())

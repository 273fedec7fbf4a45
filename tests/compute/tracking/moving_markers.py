"""Moving markers and what sensors make of them, for tests of the tracker."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import place_sensor

Array = NDArray[np.float64]

PIXELS = 2048
MIDDLE_MM = np.array([0.0, 0.0, 1500.0])


@dataclass(frozen=True)
class Sensing:
    """What sensors add: noise, losses, false peaks, and peaks too near to be told apart."""

    sigma_px: float = 0.05
    missed: float = 0.0
    false_peaks: float = 0.0
    """Expected number a sensor and exposure."""
    resolution_px: float = 0.0


def ring(sensors: int = 4) -> tuple[SensorModel, ...]:
    """Sensors on a ring of 800 mm that read 20 degrees off its radius, aimed 1.5 m away."""
    around = 2.0 * np.pi * np.arange(sensors) / sensors
    return tuple(
        place_sensor(
            f"s{index + 1}",
            lens_position_mm=(400.0 * float(np.cos(a)), 400.0 * float(np.sin(a)), 0.0),
            aim_mm=(0.0, 0.0, 1500.0),
            measured_direction=(float(np.cos(a + 0.35)), float(np.sin(a + 0.35)), 0.0),
            principal_distance_mm=36.0,
            pixels=PIXELS,
            pitch_um=12.0,
        ).model
        for index, a in enumerate(around)
    )


def bar(sensors: int = 4) -> tuple[SensorModel, ...]:
    """Sensors on a bar of 1 m, aimed 1.5 m away, that read across, along and at 45 degrees."""
    along = np.linspace(-500.0, 500.0, sensors)
    turns = np.resize([0.0, np.pi / 2, np.pi / 4, -np.pi / 4], sensors)
    return tuple(
        place_sensor(
            f"b{index + 1}",
            lens_position_mm=(float(x), 0.0, 0.0),
            aim_mm=(0.0, 0.0, 1500.0),
            measured_direction=(float(np.cos(turn)), float(np.sin(turn)), 0.0),
            principal_distance_mm=36.0,
            pixels=PIXELS,
            pitch_um=12.0,
        ).model
        for index, (x, turn) in enumerate(zip(along, turns, strict=True))
    )


def swinging(markers: int, times_s: Array, speed_mm_s: float, rng: np.random.Generator) -> Array:
    """Places (F, N, 3) of markers that swing to and fro in a cube of 400 mm, each its own way."""
    middle = MIDDLE_MM + rng.uniform(-200.0, 200.0, (markers, 3))
    velocity = speed_mm_s * rng.standard_normal((markers, 3)) / np.sqrt(3.0)
    turn = 2.0 * np.pi * rng.uniform(0.3, 1.0, (markers, 1))
    return np.asarray(middle + velocity / turn * np.sin(turn * times_s[:, None, None]))


def peaks_of(
    cameras: CameraStack,
    places_mm: Array,
    sensing: Sensing,
    rng: np.random.Generator,
    room: int | None = None,
) -> tuple[Array, Array, NDArray[np.int32], NDArray[np.int32]]:
    """Return positions, deviations, flags and the marker of each peak (-1: false), each (S, K).

    Places are (N, 3), NaN for a marker that is dark or hidden. A merged peak has the number of
    the marker with the larger share.
    """
    sensors = len(cameras)
    readings = cameras.project(places_mm)
    rows: list[list[tuple[float, int]]] = []
    for sensor in range(sensors):
        seen = [
            (float(value), marker)
            for marker, value in enumerate(readings[:, sensor])
            if np.isfinite(value)
            and -0.5 <= value <= PIXELS - 0.5
            and rng.random() >= sensing.missed
        ]
        seen.sort()
        merged: list[tuple[float, int]] = []
        for value, marker in seen:
            if merged and value - merged[-1][0] < sensing.resolution_px:
                share = rng.uniform(0.3, 0.7)
                last = merged.pop()
                value, marker = (
                    share * last[0] + (1.0 - share) * value,
                    last[1] if share > 0.5 else marker,
                )
            merged.append((value, marker))
        found = [(value + sensing.sigma_px * rng.standard_normal(), m) for value, m in merged]
        found += [
            (rng.uniform(0.0, PIXELS - 1.0), -1) for _ in range(rng.poisson(sensing.false_peaks))
        ]
        rows.append(sorted(found))
    most = max(1, *(len(row) for row in rows)) if room is None else room
    position = np.full((sensors, most), np.nan)
    owner = np.full((sensors, most), -1, dtype=np.int32)
    for sensor, row in enumerate(rows):
        for index, (value, marker) in enumerate(row):
            position[sensor, index], owner[sensor, index] = value, marker
    sigma = np.where(np.isfinite(position), sensing.sigma_px, np.nan)
    return position, sigma, np.zeros(position.shape, dtype=np.int32), owner

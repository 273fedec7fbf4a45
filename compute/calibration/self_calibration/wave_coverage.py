"""WaveCoverage: what a waved wand has covered, what is missing, and whether it is enough."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.self_calibration.initial_poses import triangulate
from compute.calibration.self_calibration.projective_reconstruction import MIN_READINGS
from compute.calibration.self_calibration.targets import Recording
from compute.calibration.self_calibration.uncalibrated_start import device_rotation
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

MIN_POSES: Final = 100
"""Poses that are enough where they cover everything (decision 20)."""
CELLS: Final = 10
"""Equal parts of a sensor's pixels."""
MIN_CELL_READINGS: Final = 3
MIN_COVERED: Final = 0.7
"""Smallest share of a sensor's cells that must have readings."""
MIN_COMPONENT: Final = 0.35
"""Smallest RMS of a component of the wand's directions; directions all over the sphere have 0.58,
and below 0.1 a calibration is refused."""
MIN_OCTANT_POSES: Final = 3
"""Poses that each eighth of the volume must have."""
MIN_DEPTH: Final = 1.0 / 3.0
"""Smallest extent of the volume, relative to the largest."""
AXES: Final = (
    ("x", "across, along the pixels of the first sensor"),
    ("y", "across, perpendicular to the pixels of the first sensor"),
    ("z", "towards the sensors"),
)
SIDES: Final = (("-x", "+x"), ("-y", "+y"), ("near", "far"))


@dataclass(frozen=True)
class SensorCoverage:
    """What one sensor saw of a wave.

    Args:
        sensor: its name.
        readings: number of readings.
        cells: readings in each of CELLS equal parts of its pixels.
    """

    sensor: str
    readings: int
    cells: tuple[int, ...]

    @property
    def covered(self) -> float:
        """Share of the cells with enough readings."""
        return sum(one >= MIN_CELL_READINGS for one in self.cells) / len(self.cells)


@dataclass(frozen=True)
class WaveCoverage:
    """Coverage of a wave as it grows.

    Args:
        poses: poses that show two markers or more to three sensors each (to four, without cameras,
            where the device has no more).
        wanted_poses: how many are enough.
        sensors: coverage of each sensor's pixels.
        directions: RMS of the components of the wand's direction along x, y, z of the device's
            frame; None without cameras.
        octants: poses in the eighths of the volume, x first; None without cameras.
        extent_mm: extent of the volume along x, y, z, without the outermost twentieths [mm]; None
            without cameras.
        missing: what is missing, in sentences.
    """

    poses: int
    wanted_poses: int
    sensors: tuple[SensorCoverage, ...]
    directions: tuple[float, float, float] | None
    octants: tuple[int, ...] | None
    extent_mm: tuple[float, float, float] | None
    missing: tuple[str, ...]

    @property
    def enough(self) -> bool:
        """Whether nothing is missing."""
        return not self.missing


def wave_coverage(
    sensors: Sequence[SensorGeometry] | Sequence[SensorModel],
    recording: Recording,
    models: Sequence[SensorModel] | None = None,
) -> WaveCoverage:
    """Judge what a wave has covered so far.

    Args:
        sensors: names and pixels of the S sensors.
        recording: readings so far.
        models: cameras, also approximate ones, or those of ``uncalibrated_start``; without any,
            directions and volume are unknown, which counts as missing.
    """
    geometry = [SensorGeometry(sensor.name, sensor.pixels) for sensor in sensors]
    readings = recording.readings_px
    seen = np.isfinite(readings)
    whole = MIN_READINGS if models is None and len(sensors) == MIN_READINGS else 3
    poses = int(((seen.sum(axis=2) >= whole).sum(axis=1) >= 2).sum())
    missing = []
    if poses < MIN_POSES:
        missing.append(f"{MIN_POSES - poses} more poses of the {MIN_POSES} that are wanted.")
    covered = tuple(
        _sensor_coverage(sensor.name, sensor.pixels, readings[..., column])
        for column, sensor in enumerate(geometry)
    )
    for sensor, one in zip(geometry, covered, strict=True):
        missing += _missing_pixels(one, sensor.pixels)
    directions = octants = extent = None
    if models is None:
        missing.append("Directions and volume are judged when there are enough poses for cameras.")
    else:
        markers = triangulate(CameraStack.of(models), readings) @ device_rotation(models).T
        ends = markers[:, [0, -1]]
        ends = ends[np.isfinite(ends).all(axis=(1, 2))]
        if len(ends):
            directions = _directions(ends)
            octants, extent = _volume(ends.mean(axis=1))
            missing += _missing_directions(directions) + _missing_volume(octants, extent)
    return WaveCoverage(poses, MIN_POSES, covered, directions, octants, extent, tuple(missing))


def _sensor_coverage(name: str, pixels: int, readings_px: Array) -> SensorCoverage:
    read = readings_px[np.isfinite(readings_px)]
    cells = np.histogram(read, CELLS, (-0.5, pixels - 0.5))[0]
    return SensorCoverage(name, len(read), tuple(cells.tolist()))


def _missing_pixels(coverage: SensorCoverage, pixels: int) -> list[str]:
    """Return which pixels a sensor lacks, where it lacks too many."""
    if coverage.readings == 0:
        return [f"Sensor {coverage.sensor} saw nothing."]
    if coverage.covered >= MIN_COVERED:
        return []
    seen = [one >= MIN_CELL_READINGS for one in coverage.cells]
    width = pixels / CELLS
    if not any(seen):
        return [f"Sensor {coverage.sensor} saw too little: {coverage.readings} readings."]
    first, last = seen.index(True), CELLS - 1 - seen[::-1].index(True)
    ranges = []
    if first > 0:
        ranges.append(f"below pixel {first * width:.0f}")
    if last < CELLS - 1:
        ranges.append(f"above pixel {(last + 1) * width:.0f}")
    between = CELLS - first - (CELLS - 1 - last) - sum(seen)
    if between:
        ranges.append(f"in {between} of {last - first + 1} tenths between")
    return [f"Sensor {coverage.sensor} saw next to nothing {' and '.join(ranges)}."]


def _directions(ends_mm: Array) -> tuple[float, float, float]:
    along = ends_mm[:, 1] - ends_mm[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    x, y, z = np.sqrt((along**2).mean(axis=0)).tolist()
    return x, y, z


def _volume(middle_mm: Array) -> tuple[tuple[int, ...], tuple[float, float, float]]:
    low, high = np.quantile(middle_mm, (0.05, 0.95), axis=0)
    x, y, z = (high - low).tolist()
    above = middle_mm > 0.5 * (low + high)
    number = above @ np.array([4, 2, 1])
    return tuple(np.bincount(number, minlength=8).tolist()), (x, y, z)


def _missing_directions(directions: tuple[float, float, float]) -> list[str]:
    return [
        f"Too few poses with the wand along {axis} ({meaning}): RMS component {value:.2f}, "
        f"{MIN_COMPONENT} is wanted."
        for (axis, meaning), value in zip(AXES, directions, strict=True)
        if value < MIN_COMPONENT
    ]


def _missing_volume(octants: tuple[int, ...], extent_mm: tuple[float, float, float]) -> list[str]:
    missing = [
        f"The volume is flat along {axis} ({meaning}): {size:.0f} mm of {max(extent_mm):.0f} mm."
        for (axis, meaning), size in zip(AXES, extent_mm, strict=True)
        if size < MIN_DEPTH * max(extent_mm)
    ]
    empty = [number for number, count in enumerate(octants) if count < MIN_OCTANT_POSES]
    if empty and not missing:
        places = [
            ", ".join(side[number >> bit & 1] for side, bit in zip(SIDES, (2, 1, 0), strict=True))
            for number in empty
        ]
        missing.append(f"Too few poses in these eighths of the volume: {'; '.join(places)}.")
    return missing

"""WaveCoverage: what a waved wand or body has covered, what is missing, whether it is enough."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.self_calibration.initial_poses import triangulate
from compute.calibration.self_calibration.projective_reconstruction import MIN_READINGS
from compute.calibration.self_calibration.recording_checks import WEAK_CONIC_LIMIT, conic_share
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.calibration.self_calibration.uncalibrated_start import device_rotation
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

MIN_POSES: Final = 100
"""Poses that are enough where they cover everything (decision 20)."""
FIRST_CAMERAS_POSES: Final = 40
"""Poses from which cameras are computed where none are given, to judge directions and volume."""
GROWTH: Final = 1.3
"""They are computed again when there are this many times the poses."""
CELLS: Final = 10
"""Equal parts of a sensor's pixels."""
MIN_CELL_READINGS: Final = 3
MIN_COVERED: Final = 0.7
"""Smallest share of a sensor's cells that must have readings, and of the bins of directions that
must have poses."""
MIN_COMPONENT: Final = 0.35
"""Smallest RMS of a component of the wand's directions; directions all over the sphere have 0.58,
and below 0.1 a calibration is refused."""
DIRECTION_RINGS: Final = (1, 4, 8)
"""Bins of equal solid angle of the half sphere of directions: a cap about z, and two rings."""
MIN_DIRECTION_POSES: Final = 2
"""Poses that a bin of directions must have to count."""
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
    """Coverage of one sensor by the readings of a wave.

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
        poses: poses that show two markers or more (of a body three) to three sensors each (to four,
            without cameras, where the device has no more).
        wanted_poses: how many are enough.
        sensors: coverage of each sensor's pixels.
        directions: RMS of the components of the wand's direction along x, y, z of the device's
            frame; of a body, of the lines between all its markers; None without cameras.
        direction_bins: poses in the bins of DIRECTION_RINGS, of the direction with z >= 0: the cap
            about z, then ring by ring, from x to y; None without cameras.
        octants: poses in the eighths of the volume, x first; None without cameras.
        extent_mm: extent of the volume along x, y, z, without the outermost twentieths [mm]; None
            without cameras.
        missing: what is missing, in sentences.
    """

    poses: int
    wanted_poses: int
    sensors: tuple[SensorCoverage, ...]
    directions: tuple[float, float, float] | None
    direction_bins: tuple[int, ...] | None
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
    """Return the coverage of a wave so far, and whether it is sufficient.

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
    is_wand = isinstance(recording.target, Wand)
    poses = int(((seen.sum(axis=2) >= whole).sum(axis=1) >= (2 if is_wand else 3)).sum())
    missing = []
    if poses < MIN_POSES:
        missing.append(f"{MIN_POSES - poses} more poses of the {MIN_POSES} that are wanted.")
    covered = tuple(
        _sensor_coverage(sensor.name, sensor.pixels, readings[..., column])
        for column, sensor in enumerate(geometry)
    )
    for sensor, one in zip(geometry, covered, strict=True):
        missing += _missing_pixels(one, sensor.pixels)
    directions = bins = octants = extent = None
    if models is None:
        missing.append(
            "Directions and volume are judged when there are enough poses for cameras."
            if is_wand
            else "Directions and volume of a body are judged by initial cameras, which it needs."
        )
    else:
        markers = triangulate(CameraStack.of(models), readings) @ device_rotation(models).T
        count = markers.shape[1]
        pairs = ([0], [count - 1]) if is_wand else np.triu_indices(count, 1)
        ends = np.stack([markers[:, pairs[0]], markers[:, pairs[1]]], axis=2).reshape(-1, 2, 3)
        ends = ends[np.isfinite(ends).all(axis=(1, 2))]
        if len(ends):
            along = ends[:, 1] - ends[:, 0]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            x, y, z = np.sqrt((along**2).mean(axis=0)).tolist()
            directions, bins = (x, y, z), direction_bins(along)
            octants, extent = _volume(ends.mean(axis=1))
            missing += _missing_directions(directions, bins, conic_share(along))
            missing += _missing_volume(octants, extent)
    return WaveCoverage(
        poses, MIN_POSES, covered, directions, bins, octants, extent, tuple(missing)
    )


def direction_bins(along: Array) -> tuple[int, ...]:
    """Count directions in bins of equal solid angle: a cap about z, then rings, from x to y.

    A wand has no front: a direction and its opposite are the same.

    Args:
        along: unit vectors, shape (N, 3).
    """
    upward = np.where(along[:, 2:] < 0.0, -along, along)
    edges = 1.0 - np.cumsum(DIRECTION_RINGS) / sum(DIRECTION_RINGS)
    ring = np.minimum((upward[:, 2:] < edges).sum(axis=1), len(DIRECTION_RINGS) - 1)
    size = np.array(DIRECTION_RINGS)[ring]
    azimuth = np.arctan2(upward[:, 1], upward[:, 0]) / (2.0 * np.pi) % 1.0
    first = np.cumsum((0, *DIRECTION_RINGS))[ring]
    number = first + np.minimum((azimuth * size).astype(np.intp), size - 1)
    return tuple(np.bincount(number, minlength=sum(DIRECTION_RINGS)).tolist())


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


def _volume(middle_mm: Array) -> tuple[tuple[int, ...], tuple[float, float, float]]:
    low, high = np.quantile(middle_mm, (0.05, 0.95), axis=0)
    x, y, z = (high - low).tolist()
    above = middle_mm > 0.5 * (low + high)
    number = above @ np.array([4, 2, 1])
    return tuple(np.bincount(number, minlength=8).tolist()), (x, y, z)


def _missing_directions(
    directions: tuple[float, float, float], bins: tuple[int, ...], conic: float
) -> list[str]:
    missing = [
        f"Too few poses with the wand along {axis} ({meaning}): RMS component {value:.2f}, "
        f"{MIN_COMPONENT} is wanted."
        for (axis, meaning), value in zip(AXES, directions, strict=True)
        if value < MIN_COMPONENT
    ]
    empty = [number for number, count in enumerate(bins) if count < MIN_DIRECTION_POSES]
    if missing:
        return missing
    if conic < WEAK_CONIC_LIMIT:
        missing.append(
            "The wand's directions lie near a cone, which leaves the scale open: hold it at other "
            f"angles, too{''.join(f', {_direction_name(one)}' for one in empty[:1])}."
        )
    elif len(bins) - len(empty) < MIN_COVERED * len(bins):
        names = "; ".join(_direction_name(one) for one in empty)
        missing.append(
            f"The wand was held in {len(bins) - len(empty)} of {len(bins)} parts of all "
            f"directions. Too few poses: {names}."
        )
    return missing


def _direction_name(number: int) -> str:
    """Return a bin of directions in words."""
    if number < DIRECTION_RINGS[0]:
        return "towards the sensors"
    ring = 1 if number < DIRECTION_RINGS[0] + DIRECTION_RINGS[1] else 2
    within = number - sum(DIRECTION_RINGS[:ring])
    azimuth = 360.0 * (within + 0.5) / DIRECTION_RINGS[ring]
    tilt = "tilted towards the sensors" if ring == 1 else "across"
    return f"{tilt} at {azimuth:.0f}° from x to y"


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

"""Plan documents: over the volume, sensor by sensor, point by point."""

from dataclasses import dataclass

from compute.camera.model import Vector3
from compute.planning.coverage import Box, Coverage
from compute.planning.data_rates import Rates
from compute.planning.ghost_points import GhostCount


@dataclass(frozen=True)
class AxisSummary:
    """Summary of one quantity along X, Y and Z over the points that can be reconstructed [mm].

    Args:
        best, median, worst: over the grid; None: no point can be reconstructed.
        centre: at the grid's point nearest to the volume's middle; None: not there.
    """

    best: Vector3 | None
    median: Vector3 | None
    worst: Vector3 | None
    centre: Vector3 | None


@dataclass(frozen=True)
class PlannedPoint:
    """One point of the grid.

    Args:
        position_mm: X, Y, Z [mm].
        sensors: how many see it.
        saturated: how many of their lines are full; the noise given here is that of lines that
            are not cut.
        sd_mm: standard deviations of X, Y, Z at the Cramer-Rao bound of the readings; None
            where there is no position.
        centroid_sd_mm: the same with the readings of threshold and centre of gravity.
        dilution_mm: the same with readings of 1 px: what the geometry alone does.
        fixed_pattern_mm: standard deviations of the error by the pixels' differences; None
            without a position, and for readings that are numbers from the start.
        distortion_mm: what perspective cameras leave of the distortion, as an error of X, Y, Z.
    """

    position_mm: Vector3
    sensors: int
    saturated: int
    sd_mm: Vector3 | None
    centroid_sd_mm: Vector3 | None
    dilution_mm: Vector3 | None
    fixed_pattern_mm: Vector3 | None
    distortion_mm: Vector3 | None


@dataclass(frozen=True)
class PlannedSensor:
    """One sensor: medians over the points that it sees.

    Args:
        name: the sensor's name.
        position_mm: where its optics are [mm].
        scan_electrons: of a whole line.
        peak_electrons: of its brightest pixel, the signal alone.
        saturated: share of the lines whose brightest pixel is full, ambient light and dark
            signal included.
        bound_px: Cramer-Rao bound of the reading, noise only [px].
        centroid_px: what threshold and centre of gravity reach [px]; None: they do not apply.
        fixed_pattern_px: error by the pixels' differences, the same in every exposure [px];
            None: readings are numbers from the start.
        misfit_px: what a perspective camera leaves of the distortion, RMS [px].
        principal_distance_px: of that camera [px].
    """

    name: str
    position_mm: Vector3
    scan_electrons: float | None
    peak_electrons: float | None
    saturated: float
    bound_px: float | None
    centroid_px: float | None
    fixed_pattern_px: float | None
    misfit_px: float
    principal_distance_px: float


@dataclass(frozen=True)
class Plan:
    """Predicted performance of a device, from its profile alone.

    ``noise`` and ``centroid`` are of the noise: an exactly calibrated device. ``fixed_pattern``
    comes on top until pixels are flat-fielded, and ``distortion`` where readings are not
    corrected for it: neither changes from exposure to exposure.

    Args:
        profile: its name.
        title: its title.
        volume: the box that was looked at.
        grid: points along X, Y, Z.
        sensors: one by one.
        noise: standard deviations at the readings' Cramer-Rao bound.
        centroid: standard deviations with threshold and centre of gravity.
        dilution: standard deviations for readings of 1 px, the geometry's share [mm/px].
        fixed_pattern: standard deviations of the error by the pixels' differences.
        distortion: absolute errors by the distortion that perspective cameras leave.
        coverage: how much of the volume is seen.
        rates: with 1 marker, and with as many as the device drives.
        planar_intersections: [2.15] for 2 markers and on, as ``ghosts``.
        ghosts: expected wrong combinations of markers lit together; empty where no volume is
            seen by all sensors, or they are more than six.
        points: of the grid, X changing slowest.
        notes: what was assumed.
    """

    profile: str
    title: str
    volume: Box
    grid: tuple[int, int, int]
    sensors: tuple[PlannedSensor, ...]
    noise: AxisSummary
    centroid: AxisSummary
    dilution: AxisSummary
    fixed_pattern: AxisSummary
    distortion: AxisSummary
    coverage: Coverage
    rates: tuple[Rates, ...]
    planar_intersections: tuple[int, ...]
    ghosts: tuple[GhostCount, ...]
    points: tuple[PlannedPoint, ...]
    notes: tuple[str, ...]

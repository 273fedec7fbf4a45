"""Plan documents: over the volume, sensor by sensor, point by point."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3, vector3
from compute.planning.budget_inputs import BudgetInput
from compute.planning.coverage import Box, Coverage
from compute.planning.data_rates import Rates
from compute.planning.error_contributions import Kind
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

    @classmethod
    def of(cls, values_mm: NDArray[np.float64], centre: int) -> "AxisSummary":
        """Summarise values of shape (N, 3) [mm]; rows with NaN are left out.

        Args:
            values_mm: of the N points of the grid.
            centre: index of the point nearest to the volume's centre.
        """
        finite = values_mm[np.isfinite(values_mm).all(axis=1)]
        if len(finite) == 0:
            return cls(None, None, None, None)
        return cls(
            vector3(finite.min(axis=0)),
            vector3(np.median(finite, axis=0)),
            vector3(finite.max(axis=0)),
            finite_vector(values_mm[centre]),
        )


def finite_vector(row: NDArray[np.float64]) -> Vector3 | None:
    """Return a row of three as a tuple; None where it holds NaN."""
    return vector3(row) if np.isfinite(row).all() else None


@dataclass(frozen=True)
class BudgetContribution:
    """One source of uncertainty, summarised over the volume.

    Args:
        name: what it is.
        kind: "random": another value in each exposure, less in a mean of many. "systematic": the
            same as long as marker and device stay as they are.
        counted: it is part of the total; otherwise what would be with another correction.
        assumed: some of its inputs are assumed.
        inputs: their names: error sources, and other sections of the profile.
        sigma: standard uncertainties along X, Y, Z.
        rms_mm: of X, Y and Z together, RMS over the points [mm].
        by_distance_mm: the same of each plane of the grid, at the budget's distances [mm].
        share: of the total variance, 0 to 1; 0 where it is not counted.
    """

    name: str
    kind: Kind
    counted: bool
    assumed: bool
    inputs: tuple[str, ...]
    sigma: AxisSummary
    rms_mm: float
    by_distance_mm: tuple[float, ...]
    share: float


@dataclass(frozen=True)
class AccuracyBudget:
    """Uncertainty budget of a point's position (GUM, JCGM 100): every source, and their sum.

    Args:
        contributions: source by source.
        dominant: name of the contribution with the largest share.
        random: root of the sum of squares of the random ones.
        systematic: of the systematic ones.
        total: of all.
        total_rms_mm: of X, Y and Z together, RMS over the points [mm].
        distances_mm: Z of the planes of the grid [mm].
        total_by_distance_mm: as ``total_rms_mm``, of each plane [mm].
        inputs: the values that it rests on.
    """

    contributions: tuple[BudgetContribution, ...]
    dominant: str
    random: AxisSummary
    systematic: AxisSummary
    total: AxisSummary
    total_rms_mm: float
    distances_mm: tuple[float, ...]
    total_by_distance_mm: tuple[float, ...]
    inputs: tuple[BudgetInput, ...]


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
        uncertainty_mm: standard uncertainties of X, Y, Z by the whole accuracy budget.
    """

    position_mm: Vector3
    sensors: int
    saturated: int
    sd_mm: Vector3 | None
    centroid_sd_mm: Vector3 | None
    dilution_mm: Vector3 | None
    fixed_pattern_mm: Vector3 | None
    distortion_mm: Vector3 | None
    uncertainty_mm: Vector3 | None


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
    corrected for it: neither changes from exposure to exposure. ``budget`` is all of it.

    Args:
        profile_id: its name.
        title: its title.
        volume: the box that was looked at.
        grid: points along X, Y, Z.
        sensors: one by one.
        noise: standard deviations at the readings' Cramer-Rao bound.
        centroid: standard deviations with threshold and centre of gravity.
        dilution: standard deviations for readings of 1 px, the geometry's share [mm/px].
        fixed_pattern: standard deviations of the error by the pixels' differences.
        distortion: absolute errors by the distortion that perspective cameras leave.
        budget: the accuracy with every source of error; None where it cannot be computed, for a
            reason in the notes.
        coverage: how much of the volume is seen.
        rates: with 1 marker, and with as many as the device drives.
        planar_intersections: [2.15] for 2 markers and on, as ``ghosts``.
        ghosts: expected wrong combinations of markers lit together; empty where no volume is
            seen by all sensors, or they are more than six.
        points: of the grid, X changing slowest.
        notes: what was assumed.
    """

    profile_id: str
    title: str
    volume: Box
    grid: tuple[int, int, int]
    sensors: tuple[PlannedSensor, ...]
    noise: AxisSummary
    centroid: AxisSummary
    dilution: AxisSummary
    fixed_pattern: AxisSummary
    distortion: AxisSummary
    budget: AccuracyBudget | None
    coverage: Coverage
    rates: tuple[Rates, ...]
    planar_intersections: tuple[int, ...]
    ghosts: tuple[GhostCount, ...]
    points: tuple[PlannedPoint, ...]
    notes: tuple[str, ...]

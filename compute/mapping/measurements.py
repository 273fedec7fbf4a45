"""MappingMeasurements: readings of markers at known positions; their checks and their grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from compute.camera.model import SensorModel, vector3
from compute.camera.observation_checks import FLATNESS_LIMIT, check_observations
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter, TooFewPoints
from compute.mapping.grid import VoxelGrid
from compute.mapping.result import MappingSettings

Array = NDArray[np.float64]

MIN_POINTS = 8
"""Smallest number of points of a sensor: the corners of one cell."""
MIN_EXTENT_SHARE = 0.1
"""Smallest extent of a sensor's points relative to that of all, along their principal axes."""
MAX_CELLS: Final = 200_000
"""Largest number of cells of a grid."""
MAX_ALONG: Final = 256
"""Largest number of cells along an axis."""
MARGIN_SPACINGS: Final = 1.0
"""Distance to which the grid reaches beyond the measurements, in distances between neighbours. So
far the field's extrapolation and its variance were found to be right; the blocks by which the
penalty is selected are one distance wide."""


@dataclass(frozen=True, eq=False)
class MappingMeasurements:
    """Readings of markers at known positions.

    Args:
        points_mm: the positions, shape (N, 3) [mm].
        readings_px: readings of them, shape (N, S) [px]; NaN where not seen.
        sigma_px: standard deviations of the readings, shape (N, S) [px]; None: estimated from the
            residuals of the fit, one for each sensor.
        position_sigma_mm: standard deviation of each coordinate of the positions, independent [mm].
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array | None = None
    position_sigma_mm: float = 0.0

    def variance_px2(self, cameras: CameraStack) -> Array:
        """Return the readings' variances with the positions' projected in, shape (N, S) [px^2].

        Without standard deviations of the readings, only the positions' share.
        """
        jacobian = cameras.linearise(self.points_mm)[1]
        variance: Array = self.position_sigma_mm**2 * (jacobian**2).sum(axis=2)
        if self.sigma_px is not None:
            variance = variance + self.sigma_px**2
        return np.where(np.isfinite(self.readings_px), variance, np.nan)


def check_measurements(measured: MappingMeasurements, models: Sequence[SensorModel]) -> None:
    """Check measurements against the sensors.

    Args:
        measured: the measurements.
        models: the S cameras.

    Raises:
        InvalidParameter: ``position_sigma_mm`` is not zero or positive, or an array is of a wrong
            shape or has a wrong value.
        NonFiniteValue, DuplicatePoint, ReadingOutsideSensor: see
            ``compute.camera.observation_checks``.
        TooFewPoints, DegeneratePoints: a sensor's points are too few, or flat.
    """
    point_sigma = measured.position_sigma_mm
    if not 0.0 <= point_sigma < np.inf:
        raise InvalidParameter(f"position_sigma_mm is {point_sigma}; it must be 0 or positive")
    points, readings = measured.points_mm, measured.readings_px
    check_observations(points, readings, models, measured.sigma_px)
    whole = _extents(points) if len(points) >= MIN_POINTS else None
    for column, model in enumerate(models):
        _check_sensor(points[np.isfinite(readings[:, column])], model, whole)


def _check_sensor(seen: Array, model: SensorModel, whole: Array | None) -> None:
    """Check the points (n, 3) that one sensor saw against the extents of all.

    Raises:
        TooFewPoints: fewer than ``MIN_POINTS``.
        DegeneratePoints: they lie in one plane or line, or on one side of the volume only.
    """
    count = len(seen)
    if count < MIN_POINTS or whole is None:
        raise TooFewPoints(
            f"sensor {model.name} saw {count} of the mapping points; at least {MIN_POINTS} are "
            "needed, and as many more as the volume is to be resolved",
            sensor=model.name,
            points=count,
        )
    extents = _extents(seen)
    if extents[2] < FLATNESS_LIMIT * extents[0]:
        raise DegeneratePoints(
            f"the {count} points that sensor {model.name} saw lie in one plane or line: "
            f"{extents[0]:.4g} x {extents[1]:.4g} x {extents[2]:.4g} mm along their axes; a table "
            "over a volume needs points at several depths",
            sensor=model.name,
        )
    share = float((extents / whole).min())
    if share < MIN_EXTENT_SHARE:
        raise DegeneratePoints(
            f"sensor {model.name} saw points on one side only: they reach over {100 * share:.1f} "
            f"% of the mapped volume in one direction, at least {100 * MIN_EXTENT_SHARE:g} % are "
            "needed; add points where it has none, or map the others' volume without it",
            sensor=model.name,
        )


def _extents(points: Array) -> Array:
    """Return the points' extents along their principal axes, largest first, shape (3,) [mm]."""
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    return np.asarray(np.sort(np.ptp(centred @ axes.T, axis=0))[::-1])


def point_spacing(measured: MappingMeasurements) -> float:
    """Return the mean distance between neighbouring points, as if evenly spread [mm]."""
    volume = float(ConvexHull(measured.points_mm).volume)
    return float(np.cbrt(volume / len(measured.points_mm)))


def grid_for_points(
    measured: MappingMeasurements, spacing: float, settings: MappingSettings
) -> VoxelGrid:
    """Return the grid over the box of the measurements.

    Args:
        measured: the measurements.
        spacing: mean distance between neighbours, the pitch if the settings have none [mm].
        settings: the mapping settings.

    Raises:
        InvalidParameter: the pitch makes too many cells.
    """
    low, high = measured.points_mm.min(axis=0), measured.points_mm.max(axis=0)
    requested = settings.pitch_mm
    wanted = np.full(3, spacing) if requested is None else np.asarray(requested)
    with np.errstate(over="ignore"):  # a tiny pitch: refused below
        counts = np.maximum((high - low) / wanted, 1.0)
    counts = np.rint(counts) if requested is None else np.ceil(counts - 1e-9)
    if requested is None:
        # Clustered points: no more cells than the limit.
        counts = np.minimum(counts, MAX_ALONG)
    if counts.max() > MAX_ALONG or counts.prod() > MAX_CELLS:
        raise InvalidParameter(
            f"pitch_mm {requested} makes {'x'.join(f'{count:.0f}' for count in counts)} cells of "
            f"the measured volume of {'x'.join(f'{side:.4g}' for side in high - low)} mm; at most "
            f"{MAX_CELLS} and {MAX_ALONG} along an axis are held, take a larger one"
        )
    pitch = (high - low) / counts if requested is None else wanted
    origin = 0.5 * (low + high) - 0.5 * pitch * counts
    x, y, z = (int(count) for count in counts)
    return VoxelGrid(vector3(origin), vector3(pitch), (x, y, z))


def add_margin(grid: VoxelGrid, spacing: float, cameras: CameraStack) -> VoxelGrid:
    """Return the grid with cells beyond the measurements, over which the field is extrapolated.

    On each side MARGIN_SPACINGS distances between neighbours; fewer where a grid would have more
    than MAX_CELLS, or where twice as many would reach behind the lens of a sensor.

    Args:
        grid: over the box of the measurements.
        spacing: mean distance between neighbours [mm].
        cameras: the S cameras.
    """
    steps = np.rint(MARGIN_SPACINGS * spacing / np.asarray(grid.pitch_mm)).astype(int)
    cells = np.asarray(grid.cells)
    while (cells + 2 * steps).max() > MAX_ALONG or (cells + 2 * steps).prod() > MAX_CELLS:
        steps = np.maximum(steps - 1, 0)
    for axis in range(3):
        for low, high in ((1, 0), (0, 1)):
            for step in range(steps[axis], 0, -1):
                doubled = grid.extended(axis, 2 * step * low, 2 * step * high)
                if np.isfinite(cameras.project(doubled.corners_mm)).all():
                    grid = grid.extended(axis, step * low, step * high)
                    break
    return grid

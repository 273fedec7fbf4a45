"""Construction of a correction table from mapping measurements."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.cell_support import (
    check_supported,
    corner_values,
    find_supported_cells,
)
from compute.mapping.coverage import Coverage
from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.grid import VoxelGrid
from compute.mapping.measurements import (
    MappingMeasurements,
    add_margin,
    check_measurements,
    grid_for_points,
    point_spacing,
)
from compute.mapping.result import (
    MappingResult,
    MappingSettings,
    MappingValidation,
    SensorMapping,
    describe_coverage,
)
from compute.mapping.sample_grid import SampleGrid
from compute.mapping.sensor_data import SensorData
from compute.mapping.sensor_fit import fit_sensor, summarise_fit
from compute.mapping.table import CorrectionTable
from compute.progress import Progress, no_progress, partial_progress

Array = NDArray[np.float64]

MAX_FUNCTIONS = 1200
"""Largest number of fitted functions; about ten along each axis of a cube."""
MIN_FUNCTIONS = 120
FUNCTIONS_PER_POINT = 2
_TYPICAL_TRIALS = 25  # of penalties, about; for the progress report only


@dataclass(frozen=True, eq=False)
class _SensorPart:
    """One sensor's part of a table."""

    coefficients_px: Array
    variance_px2: Array
    valid: NDArray[np.bool_]
    figures: SensorMapping


def build_table(
    models: Sequence[SensorModel],
    calibration_hash: str,
    measured: MappingMeasurements,
    parameter_covariance: Array | None = None,
    settings: MappingSettings | None = None,
    progress: Progress = no_progress,
) -> MappingResult:
    """Build the table of corrections, projection minus measurement.

    Thesis, end of section 5.6. By default a penalised tensor B-spline is fitted (see
    ``DiagonalisedBasis``) jointly with the calibration's own error (see ``fit_sensor``); the
    penalty is selected by cross-validation over blocks (see ``cross_validate_penalties``).

    The table's variances are those of the whole predicted reading, of the map and the calibration
    together. Reconstruction with the table takes the readings' own standard deviations and no
    covariance of the calibration's parameters.

    Args:
        models: the calibration's S cameras.
        calibration_hash: content hash of the calibration.
        measured: readings of markers at N known positions.
        parameter_covariance: joint covariance of the cameras' parameters, shape (P, P), where the
            calibration was made from other measurements than these. None: from these; then
            they tell its error, too.
        settings: how to build it.
        progress: called with the fraction done and the stage.

    Raises:
        InvalidParameter: a value is wrong, a point lies behind the lens of a sensor that read it,
            or the settings do not suit the measurements.
        NonFiniteValue, DuplicatePoint, ReadingOutsideSensor, TooFewPoints, DegeneratePoints: the
            measurements are not fit for it.
    """
    settings = settings or MappingSettings()
    check_measurements(measured, models)
    cameras = CameraStack.of(models)
    readings = cameras.add_cubic_term(measured.readings_px)
    samples = cameras.project(measured.points_mm) - readings
    behind = np.argwhere(np.isfinite(readings) & np.isnan(samples))
    if len(behind):
        row, column = (int(index) for index in behind[0])
        raise InvalidParameter(
            f"point {row + 1} was read by sensor {models[column].name}, behind whose lens it lies "
            "by the calibration; is it the right calibration, in the same frame?",
            point=row + 1,
            sensor=models[column].name,
        )
    spacing = point_spacing(measured)
    if settings.method == "b-spline":
        box = grid_for_points(measured, spacing, settings)
        _check_in_front(cameras, models, box.corners_mm)
        grid = add_margin(box, spacing, cameras)
        parts = _fit_p_splines(
            models, cameras, measured, samples, parameter_covariance, settings, grid, box, progress
        )
    else:
        sample_grid = SampleGrid.of(measured.points_mm)
        grid = sample_grid.grid
        parts = _interpolate(models, cameras, measured, samples, settings, sample_grid)
    for model, part in zip(models, parts, strict=True):
        check_supported(part.valid, model.name)
    progress(1.0, "done")
    table = CorrectionTable(
        tuple(model.name for model in models),
        calibration_hash,
        grid,
        1 if settings.method == "trilinear" else 3,
        np.stack([part.coefficients_px for part in parts]),
        np.stack([part.variance_px2 for part in parts]),
        np.stack([part.valid for part in parts]),
    )
    figures = tuple(part.figures for part in parts)
    return MappingResult(table, settings, MappingValidation(spacing, grid.pitch_mm, figures))


def _fit_p_splines(
    models: Sequence[SensorModel],
    cameras: CameraStack,
    measured: MappingMeasurements,
    samples: Array,
    parameter_covariance: Array | None,
    settings: MappingSettings,
    grid: VoxelGrid,
    box: VoxelGrid,
    progress: Progress,
) -> list[_SensorPart]:
    """Fit penalised splines, sensor by sensor."""
    spacing = point_spacing(measured)
    max_functions = int(np.clip(FUNCTIONS_PER_POINT * len(samples), MIN_FUNCTIONS, MAX_FUNCTIONS))
    functions = DiagonalisedBasis.of(grid, max_functions)
    variance = measured.variance_px2(cameras)
    block = _spatial_blocks(measured.points_mm, spacing)
    joint = (
        None if parameter_covariance is None else cameras.covariance_blocks(parameter_covariance)
    )
    parts = []
    for column, model in enumerate(models):
        seen = np.flatnonzero(np.isfinite(samples[:, column]))
        mask = cameras.parameter_mask[column]
        known = measured.sigma_px is not None
        data = SensorData(
            model.name,
            measured.points_mm[seen],
            seen,
            samples[seen, column],
            variance[seen, column] if known else np.ones(len(seen)),
            known,
            block[seen],
            partial(_parameter_jacobian, cameras, column),
            None if joint is None else joint[column, :, column][np.ix_(mask, mask)],
        )
        share = partial_progress(progress, column / len(models), (column + 1) / len(models))
        on_trial = _trial_progress(share, f"smoothness of {model.name}")
        fitted = fit_sensor(data, functions, settings.penalty_weight, on_trial)
        coverage = Coverage.of(data.points_mm)
        valid = find_supported_cells(grid, coverage, settings.min_neighbours)
        parts.append(
            _SensorPart(
                fitted.coefficients_px,
                corner_values(grid, fitted.variance_px2),
                valid,
                summarise_fit(data, fitted, float(valid.sum() / np.prod(box.cells)), coverage),
            )
        )
    return parts


def _interpolate(
    models: Sequence[SensorModel],
    cameras: CameraStack,
    measured: MappingMeasurements,
    samples: Array,
    settings: MappingSettings,
    sample_grid: SampleGrid,
) -> list[_SensorPart]:
    """Interpolate the values themselves, sensor by sensor.

    Raises:
        InvalidParameter: the measurements have no standard deviations of the readings.
    """
    if measured.sigma_px is None:
        raise InvalidParameter(
            f'the method "{settings.method}" goes through every value and cannot tell their '
            "noise; give sigma_px"
        )
    variance = measured.variance_px2(cameras)
    parts = []
    for column, model in enumerate(models):
        values = samples[:, column]
        seen = np.isfinite(values)
        coefficients, valid = sample_grid.interpolate(
            values, 1 if settings.method == "trilinear" else 3
        )
        figures = SensorMapping(
            model.name,
            int(seen.sum()),
            float(np.sqrt((values[seen] ** 2).mean())),
            0.0,
            *(None,) * 6,
            float(np.sqrt(variance[seen, column].mean())),
            1.0,
            float(valid.mean()),
            None,
            None,
            describe_coverage(float(valid.mean())),
        )
        parts.append(
            _SensorPart(coefficients, sample_grid.fill_nearest(variance[:, column]), valid, figures)
        )
    return parts


def _parameter_jacobian(cameras: CameraStack, column: int, points_mm: Array) -> Array:
    """Return d reading / d parameters of one sensor at points (N, 3), shape (N, P)."""
    by_parameter = cameras.parameter_jacobian(points_mm)[:, column]
    return np.asarray(by_parameter[:, cameras.parameter_mask[column]])


def _trial_progress(progress: Progress, stage: str) -> Callable[[], None]:
    """Return what counts one sensor's penalty trials, whose number is not known in advance."""
    trials = count(1)
    return lambda: progress(1.0 - float(np.exp(-2.0 * next(trials) / _TYPICAL_TRIALS)), stage)


def _spatial_blocks(points_mm: Array, spacing: float) -> NDArray[np.intp]:
    """Assign points to blocks: those in one cube with an edge of the spacing."""
    cube = np.floor((points_mm - points_mm.min(axis=0)) / spacing).astype(np.intp)
    _, number = np.unique(cube, axis=0, return_inverse=True)
    return number.reshape(-1)


def _check_in_front(cameras: CameraStack, models: Sequence[SensorModel], corners: Array) -> None:
    behind = np.isnan(cameras.project(corners)).any(axis=0)
    if behind.any():
        name = models[int(np.argmax(behind))].name
        raise InvalidParameter(
            f"the box of the mapping points reaches behind the lens of sensor {name}; map the "
            "volume before the sensors",
            sensor=name,
        )

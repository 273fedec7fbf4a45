"""Calibration as the thesis publishes it, looked at as any other."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration
from compute.calibration.settings import CalibrationSettings
from compute.calibration.single_sensor.design_matrix import cofactor, design_matrix
from compute.calibration.single_sensor.fit_statistics import Residuals, fit_statistics
from compute.calibration.single_sensor.sensor_fits import ControlObservations
from compute.calibration.thesis_methods.eleven_parameter_bundle import stepwise_model
from compute.calibration.thesis_methods.iterative_dlt import iterative_dlt
from compute.camera.dlt import model_from_matrix
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import NoConvergence

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]


def fit_thesis_method(
    observed: ControlObservations, settings: CalibrationSettings, progress: Progress | None = None
) -> Calibration:
    """Fit each sensor as the thesis does; covariances are those of metric cameras.

    Raises:
        TooFewPoints: "bundle-11" has more parameters than others.
        NoConvergence: the iteration left the cameras, or the finite numbers.
    """
    size = PARAMETER_COUNT * len(observed.sensors)
    covariance = np.zeros((size, size))
    residuals = np.full(observed.readings_px.shape, np.nan)
    fits = []
    for column, sensor in enumerate(observed.sensors):
        if progress is not None:
            progress(column / len(observed.sensors), f"sensor {sensor.name}")
        rows = observed.seen[:, column]
        points, readings = observed.points_mm[rows], observed.readings_px[rows, column]
        change = None
        if settings.method == "bundle-11":
            model = stepwise_model(points, readings, sensor, None)
        else:
            model, change = _iterated(points, readings, sensor)
        cameras = CameraStack.of([model])
        values = (cameras.project(points) - cameras.add_cubic_term(readings[:, None]))[:, 0]
        sigma = observed.sigma_px[rows, column] if observed.sigma_known else None
        fit, factor = fit_statistics(model, len(points), Residuals(values, sigma), change)
        block = slice(column * PARAMETER_COUNT, (column + 1) * PARAMETER_COUNT)
        matrix = design_matrix(model, points, observed.weights[rows, column])
        covariance[block, block] = cofactor(matrix) * factor
        residuals[rows, column] = values
        fits.append(fit)
    return Calibration(
        settings.method,
        tuple(fits),
        tuple(tuple(row) for row in covariance.tolist()),
        tuple(tuple(None if np.isnan(v) else v for v in row) for row in residuals.tolist()),
        settings,
    )


def _iterated(
    points_mm: Array, readings_px: Array, sensor: SensorGeometry
) -> tuple[SensorModel, float]:
    fitted = iterative_dlt(points_mm, readings_px, sensor.name)
    depth = fitted.matrix[1, :3] @ points_mm.T + fitted.matrix[1, 3]
    if not ((depth > 0).all() or (depth < 0).all()):
        raise NoConvergence(
            f"sensor {sensor.name}: the iterative DLT ended with control points on both sides "
            "of the lens; use the metric method",
            sensor=sensor.name,
        )
    model = model_from_matrix(
        fitted.matrix, sensor, points_mm.mean(axis=0), cubic_per_px2=fitted.cubic_per_px2
    )
    return model, fitted.change_px

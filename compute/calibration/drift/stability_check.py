"""Residuals of stationary markers: their readings minus what the calibration predicts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration, measurement_sigma
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, NonFiniteValue, TooFewPoints
from compute.reconstruction.triangulation import reconstruct

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StationaryMarkers:
    """Readings of N stationary markers by S sensors.

    Args:
        readings_px: now, shape (N, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N, S) [px]; None: the calibration's.
        positions_mm: their known positions, shape (N, 3) [mm]; or None.
        position_sigma_mm: standard deviation of each known coordinate [mm].
        earlier_px: their readings when the calibration was made, shape (N, S) [px]; or None.
        earlier_sigma_px: standard deviations of those; None: the calibration's.
    """

    readings_px: Array
    sigma_px: Array | None = None
    positions_mm: Array | None = None
    position_sigma_mm: float = 0.0
    earlier_px: Array | None = None
    earlier_sigma_px: Array | None = None


@dataclass(frozen=True, eq=False)
class PredictionResiduals:
    """Readings of stationary markers minus the calibration's predictions.

    Args:
        positions_mm: the M markers that can be compared, shape (M, 3) [mm].
        marker_index: their indices among the N markers, shape (M,).
        residual_px: read minus predicted, shape (M, S) [px]; NaN where there is none.
        noise_px: standard deviation of ``residual_px`` due to the readings alone, shape (M, S)
            [px].
        covariance_px2: covariance of ``residual_px``, shape (M, S, M, S) [px^2].
    """

    positions_mm: Array
    marker_index: NDArray[np.intp]
    residual_px: Array
    noise_px: Array
    covariance_px2: Array


def prediction_residuals(
    calibration: Calibration, stationary: StationaryMarkers
) -> PredictionResiduals:
    """Return the residuals of stationary markers with their covariance.

    Args:
        calibration: the calibration.
        stationary: the readings, with known positions or earlier readings.

    Raises:
        InvalidParameter: neither or both of positions and earlier readings, or wrong shapes.
        NonFiniteValue, TooFewPoints: as ``check_drift``.
    """
    models = calibration.models
    readings = np.asarray(stationary.readings_px, dtype=np.float64)
    if readings.ndim != 2 or readings.shape[1] != len(models):
        raise InvalidParameter(
            f"readings have shape {readings.shape}; it must be (N, {len(models)})"
        )
    if (stationary.positions_mm is None) == (stationary.earlier_px is None):
        raise InvalidParameter(
            "stationary markers need either known positions or earlier readings; give one of them"
        )
    for name in ("sigma_px", "earlier_px", "earlier_sigma_px"):
        value = getattr(stationary, name)
        if value is not None and value.shape != readings.shape:
            raise InvalidParameter(
                f"{name} has shape {value.shape}; it must be {readings.shape} as the readings"
            )
    cameras = CameraStack.of(models)
    if stationary.earlier_px is not None:
        return _against_earlier(calibration, cameras, readings, stationary)
    assert stationary.positions_mm is not None
    return _against_positions(calibration, cameras, readings, stationary, stationary.positions_mm)


def _against_earlier(
    calibration: Calibration, cameras: CameraStack, readings: Array, stationary: StationaryMarkers
) -> PredictionResiduals:
    earlier = np.asarray(stationary.earlier_px, dtype=np.float64)
    sensor_sigma = np.array([fit.sigma_px for fit in calibration.sensors])
    now = sensor_sigma if stationary.sigma_px is None else stationary.sigma_px
    then = sensor_sigma if stationary.earlier_sigma_px is None else stationary.earlier_sigma_px
    noise = np.broadcast_to(np.hypot(now, then), readings.shape)
    trusted = measurement_sigma(calibration, earlier, stationary.earlier_sigma_px)
    positions = reconstruct(cameras, earlier, trusted).position_mm
    marker_index = np.flatnonzero(np.isfinite(positions[:, 0]))
    residual = cameras.add_cubic_term(readings[marker_index]) - cameras.add_cubic_term(
        earlier[marker_index]
    )
    _check_any(residual)
    variance = np.where(np.isfinite(residual), noise[marker_index] ** 2, 0.0)
    covariance = np.diag(variance.ravel()).reshape(*residual.shape, *residual.shape)
    return PredictionResiduals(
        positions[marker_index], marker_index, residual, noise[marker_index], covariance
    )


def _against_positions(
    calibration: Calibration,
    cameras: CameraStack,
    readings: Array,
    stationary: StationaryMarkers,
    positions_mm: Array,
) -> PredictionResiduals:
    positions = np.asarray(positions_mm, dtype=np.float64)
    if positions.shape != (len(readings), 3):
        raise InvalidParameter(
            f"positions have shape {positions.shape}; it must be ({len(readings)}, 3)"
        )
    if not np.isfinite(positions).all():
        raise NonFiniteValue(
            f"position {int(np.argwhere(~np.isfinite(positions))[0, 0]) + 1} is not finite"
        )
    if not 0.0 <= stationary.position_sigma_mm < np.inf:
        raise InvalidParameter(
            f"position_sigma_mm is {stationary.position_sigma_mm}; it must be 0 or more"
        )
    noise = measurement_sigma(calibration, readings, stationary.sigma_px)
    expected, position_jacobian = cameras.linearise(positions)
    residual = cameras.add_cubic_term(readings) - expected
    _check_any(residual)
    jacobian = np.nan_to_num(cameras.parameter_jacobian(positions))
    blocks = cameras.covariance_blocks(np.array(calibration.covariance))
    covariance: Array = np.einsum("nsp,sptq,mtq->nsmt", jacobian, blocks, jacobian, optimize=True)
    markers = np.arange(len(positions))
    position_jacobian = np.nan_to_num(position_jacobian)
    covariance[markers, :, markers] += (
        stationary.position_sigma_mm**2 * position_jacobian @ position_jacobian.transpose(0, 2, 1)
    )
    flat = np.array(covariance.reshape(residual.size, residual.size))
    flat[np.diag_indices(residual.size)] += np.where(np.isfinite(residual), noise**2, 0.0).ravel()
    return PredictionResiduals(
        positions, markers, residual, noise, flat.reshape(*residual.shape, *residual.shape)
    )


def _check_any(residual: Array) -> None:
    if not np.isfinite(residual).any():
        raise TooFewPoints(
            "no stationary marker can be compared: it must be read now and, without known "
            "positions, have been read by three sensors or more before"
        )


def lens_positions(models: Sequence[SensorModel], aimed_at_mm: Array) -> Array:
    """Return the lenses' positions, about which a knock rotates a sensor, shape (S, 3) [mm].

    Readings without distortion do not tell where along its slit a lens is; such a lens is taken to
    be aimed at a point.

    Args:
        models: S cameras.
        aimed_at_mm: the point, shape (3,) [mm].
    """
    positions = []
    for model in models:
        row = model.rotation[1]
        along = -row @ aimed_at_mm if model.distortion is None else model.distortion.offset_y_mm
        offset = np.array([model.offset_x_mm, along, model.offset_z_mm])
        positions.append(-model.rotation.T @ offset)
    return np.array(positions)

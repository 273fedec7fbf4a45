"""Is a calibration still good? A still set of markers is read again; which sensor moved, and how.

The markers' places are known, or they were read when the calibration was made. The second is
finer: what the calibration itself is wrong by has not changed since.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from compute.calibration.drift.stability_check import (
    PredictionResiduals,
    StationaryMarkers,
    prediction_residuals,
)
from compute.calibration.result import Calibration
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

FALSE_ALARM_PROBABILITY: Final = 0.01
"""Chance that a good calibration is called bad; divided by the sensors for each of them."""
EXPLANATIONS: Final = {
    "rotation_y_rad": "turned about its slit",
    "rotation_z_rad": "rolled about its view",
    "principal_distance_px": "its lens went nearer or farther",
    "rotation_x_rad": "tilted about its row",
    "offset_z_mm": "moved along its view",
}
"""How a sensor may have moved, by one parameter; a shift along the row or of the principal point
looks like a turn about the slit."""


@dataclass(frozen=True)
class SensorDrift:
    """What the still set says of one sensor.

    Args:
        sensor: its name.
        readings: that were compared.
        rms_px: of read less expected [px].
        p_value: chance of a misfit as large without any change.
        moved: whether that is too small to be chance.
        parameter: whose change explains most of it; None where it has not moved.
        description: the same in words; empty where it has not moved.
        change: of this parameter, in the unit of its name.
        change_sigma: its standard deviation.
        p_value_with_change: chance of the misfit that is left with this change.
    """

    sensor: str
    readings: int
    rms_px: float
    p_value: float
    moved: bool
    parameter: str | None
    description: str
    change: float | None
    change_sigma: float | None
    p_value_with_change: float | None


@dataclass(frozen=True)
class DriftCheck:
    """Whether a calibration still holds.

    Args:
        good: whether the still set is read as the calibration expects, within its uncertainty.
        p_value: chance of a misfit as large without any change.
        chi2: the misfit, all readings together with their joint covariance.
        dof: readings compared.
        rigid_motion: the misfit is that of the set, or the device, having moved as a rigid whole:
            no sensor need have moved in the device.
        rotation_rad: by how much it turned then [rad]; None otherwise.
        translation_mm: by how much its middle moved [mm]; None otherwise.
        sensors: one for each, in the device's order.
    """

    good: bool
    p_value: float
    chi2: float
    dof: int
    rigid_motion: bool
    rotation_rad: float | None
    translation_mm: float | None
    sensors: tuple[SensorDrift, ...]


def check_drift(calibration: Calibration, stationary: StationaryMarkers) -> DriftCheck:
    """Test whether a calibration still expects what is read of a still set of markers.

    Args:
        calibration: the calibration.
        stationary: the readings, with places or earlier readings.

    Raises:
        InvalidParameter: neither or both of places and earlier readings, or wrong shapes.
        NonFiniteValue: a place is not finite.
        TooFewPoints: nothing can be compared.
    """
    compared = prediction_residuals(calibration, stationary)
    cameras = CameraStack.of(calibration.models)
    seen = np.isfinite(compared.residual_px)
    chi2, dof = _chi2(compared, seen)
    p_value = float(chdtrc(dof, chi2))
    jacobian = np.nan_to_num(cameras.parameter_jacobian(compared.positions_mm))
    limit = FALSE_ALARM_PROBABILITY / len(cameras)
    sensors = tuple(
        _sensor_drift(calibration, compared, seen, jacobian, column, limit)
        for column in range(len(cameras))
    )
    good = p_value >= FALSE_ALARM_PROBABILITY
    whole = None
    if not good and sum(sensor.moved for sensor in sensors) > 1:
        whole = _fit_rigid_motion(cameras, compared, seen)
    return DriftCheck(
        good,
        p_value,
        chi2,
        dof,
        whole is not None,
        None if whole is None else whole[0],
        None if whole is None else whole[1],
        sensors,
    )


def _chi2(compared: PredictionResiduals, which: NDArray[np.bool_]) -> tuple[float, int]:
    """Return chi2 and the number of the readings of a mask (M, S)."""
    flat = which.ravel()
    residual = compared.residual_px.ravel()[flat]
    covariance = _covariance_matrix(compared)[np.ix_(flat, flat)]
    return float(residual @ np.linalg.solve(covariance, residual)), len(residual)


def _covariance_matrix(compared: PredictionResiduals) -> Array:
    return compared.covariance_px2.reshape(compared.residual_px.size, -1)


def _fit_change(
    compared: PredictionResiduals, which: NDArray[np.bool_], columns: Array
) -> tuple[Array, Array, float]:
    """Fit changes (C,) with slopes (M, S, C) to a mask's readings: values, covariance, chi2."""
    flat = which.ravel()
    residual = compared.residual_px.ravel()[flat]
    design = columns.reshape(flat.size, -1)[flat]
    whiten = np.linalg.inv(np.linalg.cholesky(_covariance_matrix(compared)[np.ix_(flat, flat)]))
    rows, right = whiten @ design, whiten @ residual
    values: Array = np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)
    left = right - rows @ values
    cofactor: Array = np.asarray(np.linalg.pinv(rows.T @ rows), dtype=np.float64)
    return values, cofactor, float(left @ left)


def _sensor_drift(
    calibration: Calibration,
    compared: PredictionResiduals,
    seen: NDArray[np.bool_],
    jacobian: Array,
    column: int,
    limit: float,
) -> SensorDrift:
    model = calibration.models[column]
    own = np.zeros_like(seen)
    own[:, column] = seen[:, column]
    count = int(own.sum())
    if count == 0:
        return SensorDrift(model.name, 0, 0.0, 1.0, False, None, "", None, None, None)
    chi2, dof = _chi2(compared, own)
    p_value = float(chdtrc(dof, chi2))
    rms = float(np.sqrt(np.mean(compared.residual_px[own] ** 2)))
    if p_value >= limit:
        return SensorDrift(model.name, count, rms, p_value, False, None, "", None, None, None)
    best: tuple[float, str, float, float] | None = None
    for name in EXPLANATIONS:
        index = model.parameter_names.index(name)
        change_jacobian = np.zeros((*seen.shape, 1))
        change_jacobian[:, column, 0] = jacobian[:, column, index]
        values, covariance, left = _fit_change(compared, own, change_jacobian)
        if best is None or left < best[0]:
            best = left, name, float(values[0]), float(np.sqrt(covariance[0, 0]))
    assert best is not None
    left, name, change, sigma = best
    after = float(chdtrc(dof - 1, left)) if dof > 1 else None
    return SensorDrift(
        model.name, count, rms, p_value, True, name, EXPLANATIONS[name], change, sigma, after
    )


def _fit_rigid_motion(
    cameras: CameraStack, compared: PredictionResiduals, seen: NDArray[np.bool_]
) -> tuple[float, float] | None:
    """Return turn [rad] and shift [mm] if a rigid motion of the set explains the misfit."""
    dof = int(seen.sum()) - 6
    if dof < 1 or len(compared.positions_mm) < 3:
        return None
    position_jacobian = np.nan_to_num(cameras.linearise(compared.positions_mm)[1])
    arms = compared.positions_mm - compared.positions_mm.mean(axis=0)
    motion = np.concatenate([np.cross(arms[:, None], position_jacobian), position_jacobian], axis=2)
    values, _, left = _fit_change(compared, seen, motion)
    if chdtrc(dof, left) < FALSE_ALARM_PROBABILITY:
        return None
    return float(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:]))

"""Drift detection from stationary markers: whether a sensor moved, which one, and how.

The markers' positions are known, or they were read when the calibration was made. The second is
more sensitive: the calibration's own error is the same in both readings and cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from compute.calibration.bundle_adjustment.gauge import shift_origins
from compute.calibration.drift.stability_check import (
    PredictionResiduals,
    StationaryMarkers,
    lens_positions,
    prediction_residuals,
)
from compute.calibration.result import Calibration
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

FALSE_ALARM_PROBABILITY: Final = 0.01
"""Probability of a false alarm; divided by the number of sensors for each of them."""
EXPLANATIONS: Final = {
    "rotation_y_rad": "rotated about its slit",
    "rotation_z_rad": "rolled about its optical axis",
    "principal_distance_px": "its lens moved along the optical axis",
    "rotation_x_rad": "tilted about its row",
    "offset_z_mm": "moved along its optical axis",
}
"""Single-parameter motions of a sensor, rotations about its lens; a translation along the row or a
shift of the principal point is equivalent to a rotation about the slit."""


@dataclass(frozen=True)
class SensorDrift:
    """Drift test of one sensor.

    Args:
        sensor: its name.
        readings: number of readings compared.
        rms_px: RMS of read minus expected [px].
        p_value: probability of a misfit at least as large without drift.
        moved: whether ``p_value`` is below the threshold.
        parameter: the parameter whose change explains the misfit best; None if not moved.
        description: the same for people; empty if not moved.
        change: of this parameter, in the unit of its name.
        change_sigma: its standard deviation.
        p_value_with_change: probability of the misfit that remains with this change.
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
    """Drift test of a device.

    Args:
        good: whether the readings agree with the calibration within its uncertainty.
        p_value: probability of a misfit at least as large without drift.
        chi2: the misfit of all readings with their joint covariance.
        dof: number of readings compared.
        rigid_motion: the markers, or the device as a whole, moved rigidly: this explains the
            misfit, and no sensor need have moved within the device.
        rotation_rad: angle of that motion [rad]; None without.
        translation_mm: length of its translation [mm]; None without.
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
    """Test whether readings of stationary markers agree with a calibration.

    Args:
        calibration: the calibration.
        stationary: the readings, with known positions or earlier readings.

    Raises:
        InvalidParameter: neither or both of positions and earlier readings, or wrong shapes.
        NonFiniteValue: a position is not finite.
        TooFewPoints: nothing can be compared.
    """
    compared = prediction_residuals(calibration, stationary)
    cameras = CameraStack.of(calibration.models)
    measured = np.isfinite(compared.residual_px)
    chi2, dof = _chi2(compared, measured)
    p_value = float(chdtrc(dof, chi2))
    jacobian = _lens_motion_jacobian(calibration.models, cameras, compared.positions_mm)
    limit = FALSE_ALARM_PROBABILITY / len(cameras)
    sensors = tuple(
        _sensor_drift(calibration, compared, measured, jacobian, column, limit)
        for column in range(len(cameras))
    )
    good = p_value >= FALSE_ALARM_PROBABILITY
    motion = None
    if not good and sum(sensor.moved for sensor in sensors) > 1:
        motion = _fit_rigid_motion(cameras, compared, measured)
    angle, shift = motion or (None, None)
    return DriftCheck(good, p_value, chi2, dof, motion is not None, angle, shift, sensors)


def _lens_motion_jacobian(
    models: Sequence[SensorModel], cameras: CameraStack, positions_mm: Array
) -> list[Array]:
    """Return each sensor's readings by its parameters, (M, P) each, with rotations about its lens.

    The parameters' own rotations are about the world's origin, wherever that is.
    """
    jacobian = np.nan_to_num(cameras.parameter_jacobian(positions_mm))
    lenses = lens_positions(models, positions_mm.mean(axis=0))
    columns = []
    for column, (model, lens) in enumerate(zip(models, lenses, strict=True)):
        to_world = shift_origins([model], [-model.rotation @ lens])
        columns.append(jacobian[:, column, cameras.parameter_mask[column]] @ to_world)
    return columns


def _chi2(compared: PredictionResiduals, which: NDArray[np.bool_]) -> tuple[float, int]:
    """Return chi2 of a mask's readings (M, S), and their number."""
    residual, covariance = _selected(compared, which)
    return float(residual @ np.linalg.solve(covariance, residual)), len(residual)


def _selected(compared: PredictionResiduals, which: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the residuals of a mask's readings and their covariance."""
    flat = which.ravel()
    covariance = compared.covariance_px2.reshape(flat.size, -1)
    return compared.residual_px.ravel()[flat], covariance[np.ix_(flat, flat)]


def _fit_change(
    compared: PredictionResiduals, which: NDArray[np.bool_], columns: Array
) -> tuple[Array, Array, float]:
    """Fit changes (C,) with Jacobian (M, S, C) to a mask's readings: values, covariance, chi2."""
    residual, covariance = _selected(compared, which)
    design = columns.reshape(which.size, -1)[which.ravel()]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    rows, right = whiten @ design, whiten @ residual
    values: Array = np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)
    rest = right - rows @ values
    cofactor: Array = np.asarray(np.linalg.pinv(rows.T @ rows), dtype=np.float64)
    return values, cofactor, float(rest @ rest)


def _sensor_drift(
    calibration: Calibration,
    compared: PredictionResiduals,
    measured: NDArray[np.bool_],
    jacobian: list[Array],
    column: int,
    limit: float,
) -> SensorDrift:
    model = calibration.models[column]
    of_sensor = np.zeros_like(measured)
    of_sensor[:, column] = measured[:, column]
    count = int(of_sensor.sum())
    if count == 0:
        return SensorDrift(model.name, 0, 0.0, 1.0, False, None, "", None, None, None)
    chi2, dof = _chi2(compared, of_sensor)
    p_value = float(chdtrc(dof, chi2))
    rms = float(np.sqrt(np.mean(compared.residual_px[of_sensor] ** 2)))
    if p_value >= limit:
        return SensorDrift(model.name, count, rms, p_value, False, None, "", None, None, None)
    fits = []
    for name in EXPLANATIONS:
        change_jacobian = np.zeros((*measured.shape, 1))
        change_jacobian[:, column, 0] = jacobian[column][:, model.parameter_names.index(name)]
        values, covariance, chi2_after = _fit_change(compared, of_sensor, change_jacobian)
        fits.append((chi2_after, name, float(values[0]), float(np.sqrt(covariance[0, 0]))))
    chi2_after, name, change, sigma = min(fits, key=lambda fit: fit[0])
    after = float(chdtrc(dof - 1, chi2_after)) if dof > 1 else None
    return SensorDrift(
        model.name, count, rms, p_value, True, name, EXPLANATIONS[name], change, sigma, after
    )


def _fit_rigid_motion(
    cameras: CameraStack, compared: PredictionResiduals, measured: NDArray[np.bool_]
) -> tuple[float, float] | None:
    """Return angle [rad] and translation [mm] if a rigid motion explains the misfit."""
    dof = int(measured.sum()) - 6
    if dof < 1 or len(compared.positions_mm) < 3:
        return None
    position_jacobian = np.nan_to_num(cameras.linearise(compared.positions_mm)[1])
    arms = compared.positions_mm - compared.positions_mm.mean(axis=0)
    motion = np.concatenate([np.cross(arms[:, None], position_jacobian), position_jacobian], axis=2)
    values, _, chi2_after = _fit_change(compared, measured, motion)
    if chdtrc(dof, chi2_after) < FALSE_ALARM_PROBABILITY:
        return None
    return float(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:]))

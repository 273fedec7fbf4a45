"""Is a calibration still good? A still set of markers is read again; which sensor moved, and how.

The markers' places are known, or they were read when the calibration was made. The second is
finer: what the calibration itself is wrong by has not changed since.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from compute.calibration.result import Calibration
from compute.calibration.still_set import Comparison, StillSet, compare
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

FALSE_ALARM: Final = 0.01
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
        meaning: the same in words; empty where it has not moved.
        change: of this parameter, in the unit of its name.
        change_sigma: its standard deviation.
        p_value_explained: chance of the misfit that is left with this change.
    """

    sensor: str
    readings: int
    rms_px: float
    p_value: float
    moved: bool
    parameter: str | None
    meaning: str
    change: float | None
    change_sigma: float | None
    p_value_explained: float | None


@dataclass(frozen=True)
class DriftCheck:
    """Whether a calibration still holds.

    Args:
        good: whether the still set is read as the calibration expects, within its uncertainty.
        p_value: chance of a misfit as large without any change.
        chi2: the misfit, all readings together with their joint covariance.
        degrees_of_freedom: readings compared.
        as_a_whole: the misfit is that of the set, or the device, having moved as a rigid whole:
            no sensor need have moved in the device.
        turned_rad: by how much it turned then [rad]; None otherwise.
        shifted_mm: by how much its middle moved [mm]; None otherwise.
        sensors: one for each, in the device's order.
    """

    good: bool
    p_value: float
    chi2: float
    degrees_of_freedom: int
    as_a_whole: bool
    turned_rad: float | None
    shifted_mm: float | None
    sensors: tuple[SensorDrift, ...]


def check_drift(calibration: Calibration, still: StillSet) -> DriftCheck:
    """Test whether a calibration still expects what is read of a still set of markers.

    Args:
        calibration: the calibration.
        still: the readings, with places or earlier readings.

    Raises:
        InvalidParameter: neither or both of places and earlier readings, or wrong shapes.
        NonFiniteValue: a place is not finite.
        TooFewPoints: nothing can be compared.
    """
    compared = compare(calibration, still)
    cameras = CameraStack.of(calibration.models)
    seen = np.isfinite(compared.off_px)
    chi2, freedom = _misfit(compared, seen)
    p_value = float(chdtrc(freedom, chi2))
    slopes = np.nan_to_num(cameras.parameter_jacobian(compared.places_mm))
    limit = FALSE_ALARM / len(cameras)
    sensors = tuple(
        _sensor_drift(calibration, compared, seen, slopes, column, limit)
        for column in range(len(cameras))
    )
    good = p_value >= FALSE_ALARM
    whole = None
    if not good and sum(sensor.moved for sensor in sensors) > 1:
        whole = _as_a_whole(cameras, compared, seen)
    return DriftCheck(
        good,
        p_value,
        chi2,
        freedom,
        whole is not None,
        None if whole is None else whole[0],
        None if whole is None else whole[1],
        sensors,
    )


def _misfit(compared: Comparison, which: NDArray[np.bool_]) -> tuple[float, int]:
    """Return chi2 and the number of the readings of a mask (M, S)."""
    flat = which.ravel()
    off = compared.off_px.ravel()[flat]
    covariance = _flat(compared)[np.ix_(flat, flat)]
    return float(off @ np.linalg.solve(covariance, off)), len(off)


def _flat(compared: Comparison) -> Array:
    return compared.covariance_px2.reshape(compared.off_px.size, -1)


def _explained(
    compared: Comparison, which: NDArray[np.bool_], columns: Array
) -> tuple[Array, Array, float]:
    """Fit changes (C,) with slopes (M, S, C) to a mask's readings: values, covariance, chi2."""
    flat = which.ravel()
    off = compared.off_px.ravel()[flat]
    design = columns.reshape(flat.size, -1)[flat]
    whiten = np.linalg.inv(np.linalg.cholesky(_flat(compared)[np.ix_(flat, flat)]))
    rows, right = whiten @ design, whiten @ off
    values: Array = np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)
    left = right - rows @ values
    cofactor: Array = np.asarray(np.linalg.pinv(rows.T @ rows), dtype=np.float64)
    return values, cofactor, float(left @ left)


def _sensor_drift(
    calibration: Calibration,
    compared: Comparison,
    seen: NDArray[np.bool_],
    slopes: Array,
    column: int,
    limit: float,
) -> SensorDrift:
    model = calibration.models[column]
    own = np.zeros_like(seen)
    own[:, column] = seen[:, column]
    count = int(own.sum())
    if count == 0:
        return SensorDrift(model.name, 0, 0.0, 1.0, False, None, "", None, None, None)
    chi2, freedom = _misfit(compared, own)
    p_value = float(chdtrc(freedom, chi2))
    rms = float(np.sqrt(np.mean(compared.off_px[own] ** 2)))
    if p_value >= limit:
        return SensorDrift(model.name, count, rms, p_value, False, None, "", None, None, None)
    best: tuple[float, str, float, float] | None = None
    for name in EXPLANATIONS:
        place = model.parameter_names.index(name)
        by_change = np.zeros((*seen.shape, 1))
        by_change[:, column, 0] = slopes[:, column, place]
        values, covariance, left = _explained(compared, own, by_change)
        if best is None or left < best[0]:
            best = left, name, float(values[0]), float(np.sqrt(covariance[0, 0]))
    assert best is not None
    left, name, change, sigma = best
    after = float(chdtrc(freedom - 1, left)) if freedom > 1 else None
    return SensorDrift(
        model.name, count, rms, p_value, True, name, EXPLANATIONS[name], change, sigma, after
    )


def _as_a_whole(
    cameras: CameraStack, compared: Comparison, seen: NDArray[np.bool_]
) -> tuple[float, float] | None:
    """Return turn [rad] and shift [mm] if a rigid motion of the set explains the misfit."""
    freedom = int(seen.sum()) - 6
    if freedom < 1 or len(compared.places_mm) < 3:
        return None
    by_place = np.nan_to_num(cameras.linearised(compared.places_mm)[1])
    arms = compared.places_mm - compared.places_mm.mean(axis=0)
    motion = np.concatenate([np.cross(arms[:, None], by_place), by_place], axis=2)
    values, _, left = _explained(compared, seen, motion)
    if chdtrc(freedom, left) < FALSE_ALARM:
        return None
    return float(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:]))

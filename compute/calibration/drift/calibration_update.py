"""Update of a calibration from stationary markers: few parameters, with the old as the prior."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.gauge import shift_origins
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.drift.stability_check import (
    StationaryMarkers,
    lens_positions,
    prediction_residuals,
)
from compute.calibration.result import Calibration, nested_rows
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, UnknownSensor

Array = NDArray[np.float64]

ALLOWANCE: Final = {
    "rotation_x_rad": 5e-3,
    "rotation_y_rad": 5e-3,
    "rotation_z_rad": 5e-3,
    "principal_distance_px": 10.0,
}
"""Standard deviations of changes: a knock rotates a sensor about its lens, a temperature change
moves the lens. A translation by some hundredths of a millimetre is equivalent to a rotation."""
EXACT_MM: Final = 1e-6
"""Standard deviation of positions that count as known."""
LENS_SHIFT_MM: Final = 1e-3
"""Standard deviation of the position of a lens that turns: so small that the readings do not show
it, and large enough to leave the equations regular."""
MAX_ITERATIONS: Final = 5000
"""Largest number of trial steps. Readings that are much more precise than the calibration leave
curved valleys where its distortion is hardly known: most searches take ten steps, some a
thousand."""
OFFSETS: Final = ("offset_x_mm", "offset_y_mm", "offset_z_mm")


def update_calibration(
    calibration: Calibration,
    stationary: StationaryMarkers,
    *,
    sensors: Sequence[str] | None = None,
    allowance: dict[str, float] | None = None,
) -> Calibration:
    """Update a calibration from stationary markers, with itself as the prior.

    The parameters that may have changed get an extra variance on top of the calibration's
    covariance; the readings then determine the change. With few markers they determine little, and
    the rest keeps its values. Relative to earlier readings only the change is estimated and its
    covariance added, as the calibration's own error is the same before and after.

    Args:
        calibration: a metric calibration or one without known coordinates.
        stationary: the readings, with known positions or earlier readings.
        sensors: names of those that may have changed, from ``check_drift``; None: all.
        allowance: standard deviation of the change by parameter name, rotations about the lens;
            None: ALLOWANCE.

    Returns:
        The calibration with method "update"; residuals are those of the stationary markers.

    Raises:
        UnknownSensor: the device has no sensor of this name.
        InvalidParameter: no parameter of this name, or a standard deviation that is not positive.
        TooFewPoints, NonFiniteValue: as ``check_drift``.
    """
    check_update(calibration, sensors=sensors, allowance=allowance)
    compared = prediction_residuals(calibration, stationary)
    models = calibration.models
    lenses = lens_positions(models, compared.positions_mm.mean(axis=0))
    about_lenses = shift_origins(
        models, [model.rotation @ lens for model, lens in zip(models, lenses, strict=True)]
    )
    changes = _changes(calibration, sensors, ALLOWANCE if allowance is None else allowance)
    old = np.array(calibration.covariance)
    cameras = CameraStack.of(models)
    measured = np.isfinite(compared.residual_px)
    expected = cameras.project(compared.positions_mm)
    readings = np.where(measured, expected + compared.residual_px, np.nan)
    relative = stationary.earlier_px is not None
    before = np.diag(changes**2)
    if not relative:
        before += about_lenses @ old @ about_lenses.T
    free = np.diagonal(before) > 0.0
    information = np.zeros_like(before)
    information[np.ix_(free, free)] = np.linalg.inv(before[np.ix_(free, free)])
    position_sigma = EXACT_MM if relative else max(stationary.position_sigma_mm, EXACT_MM)
    poses = PoseSet.points(
        compared.positions_mm,
        readings,
        np.where(measured, compared.noise_px, 1.0),
        compared.positions_mm,
        np.broadcast_to(position_sigma**2 * np.eye(3), (len(readings), 3, 3)),
    )
    adjusted = adjust(
        models,
        [poses],
        prior=SensorPrior(models, information, lenses),
        free=free,
        max_iterations=MAX_ITERATIONS,
    )
    covariance = adjusted.sensor_covariance + (old if relative else 0.0)
    counts = [model.parameter_count for model in models]
    touched = [part.any() for part in np.split(free, np.cumsum(counts)[:-1])]
    residuals = np.full(stationary.readings_px.shape, np.nan)
    residuals[compared.marker_index] = adjusted.residuals[0][:, 0] * compared.noise_px
    return Calibration(
        "update",
        tuple(
            replace(fit, model=model) if changed else fit
            for fit, model, changed in zip(
                calibration.sensors, adjusted.models, touched, strict=True
            )
        ),
        tuple(tuple(row) for row in covariance.tolist()),
        nested_rows(residuals),
        settings=calibration.settings,
    )


def check_update(
    calibration: Calibration,
    *,
    sensors: Sequence[str] | None = None,
    allowance: dict[str, float] | None = None,
) -> None:
    """Check the options of ``update_calibration``, without readings.

    Args:
        calibration: the calibration.
        sensors: names of those that may have changed; None: all.
        allowance: standard deviation of the change by parameter name; None: ALLOWANCE.

    Raises:
        UnknownSensor: the device has no sensor of this name.
        InvalidParameter: no parameter of this name, a standard deviation that is not positive, or
            a camera with a cubic term.
    """
    for model in calibration.models:
        if model.cubic_per_px2 != 0.0:
            raise InvalidParameter(
                f"sensor {model.name} has the cubic term {model.cubic_per_px2:g} of the method "
                f"{calibration.method}; only metric cameras are updated: calibrate again"
            )
    _changes(calibration, sensors, ALLOWANCE if allowance is None else allowance)


def _changes(
    calibration: Calibration, sensors: Sequence[str] | None, allowance: dict[str, float]
) -> Array:
    """Return the standard deviation of every parameter's change about the lens, shape (P,).

    The offsets of a lens that turns vary: seen from the lens by LENS_SHIFT_MM.

    Raises:
        UnknownSensor: the device has no sensor of this name.
        InvalidParameter: no parameter of this name, or a standard deviation that is not positive.
    """
    names = [model.name for model in calibration.models]
    for name in sensors or ():
        if name not in names:
            raise UnknownSensor(
                f"there is no sensor {name}; the device has {', '.join(names)}", sensor=name
            )
    parameter_names = {name for model in calibration.models for name in model.parameter_names}
    for name, sigma in allowance.items():
        if name not in parameter_names or not 0.0 < sigma < np.inf:
            raise InvalidParameter(
                f"allowance has {name} = {sigma}; it must be one of "
                f"{', '.join(sorted(parameter_names))} with a positive standard deviation"
            )
    given = dict.fromkeys(OFFSETS, LENS_SHIFT_MM) | allowance
    return np.array(
        [
            given.get(name, 0.0) if sensors is None or model.name in sensors else 0.0
            for model in calibration.models
            for name in model.parameter_names
        ]
    )

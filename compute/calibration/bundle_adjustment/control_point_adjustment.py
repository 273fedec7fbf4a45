"""Joint adjustment of all sensors and of control points that have an uncertainty of their own."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.data_snooping import redundancy
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.single_sensor.design_matrix import fitted_columns
from compute.calibration.single_sensor.sensor_fits import ControlObservations, SensorFits
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

MIN_REDUNDANCY: Final = 4.0
"""Readings of a sensor that must check others before their residuals tell its deviation."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """Sensors and points that fit the readings and the given points best.

    Args:
        models: the cameras.
        covariance: joint, shape (P, P), for the deviations as given; 0 for what is not fitted.
        residuals_px: fitted minus measured, with the points where they are now, shape (N, S).
        shifts_mm: fitted minus given points, shape (N, 3).
        sigma_ratio: each sensor's deviation, as its residuals show it, over the one given, (S,).
        redundancy: readings of each sensor that check others, their number in all, (S,).
    """

    models: tuple[SensorModel, ...]
    covariance: Array
    residuals_px: Array
    shifts_mm: Array
    sigma_ratio: Array
    redundancy: Array


def adjust_control_points(
    observed: ControlObservations,
    fits: SensorFits,
    sigma_px: Array,
    control_sigma_mm: float,
    progress: Progress | None = None,
) -> JointFit:
    """Fit all sensors and the control points at once; each coordinate has a prior.

    A point that is not where it was said to be moves the readings of all sensors that see it:
    their parameters are correlated by it.

    Args:
        observed: the readings.
        fits: cameras to start from, with the readings' weights and the offsets' prior.
        sigma_px: deviations of the readings, shape (N, S) [px].
        control_sigma_mm: standard deviation of each coordinate.
        progress: called with the fraction done and the stage.

    Raises:
        NoConvergence, UndeterminedParameters: see ``adjust``.
    """
    points = observed.points_mm
    counts = observed.seen & (fits.weights > 0.0)
    poses = PoseSet.points(
        points,
        np.where(counts, observed.readings_px, np.nan),
        np.where(counts, sigma_px / np.sqrt(np.where(counts, fits.weights, 1.0)), np.nan),
        points,
        np.broadcast_to(control_sigma_mm**2 * np.eye(3), (len(points), 3, 3)),
    )
    free = np.concatenate(
        [np.isin(np.arange(m.parameter_count), fitted_columns(m)) for m in fits.models]
    )
    found = adjust(fits.models, [poses], prior=_prior(fits), free=free, progress=progress)
    adjusted = found.pose_sets[0].translation_mm
    residuals = CameraStack.of(found.models).project(adjusted) - observed.readings_px
    share = redundancy(found)[:, 0]
    squares = np.nansum(found.residuals[0][:, 0] ** 2, axis=0)
    checked = share.sum(axis=0)
    return JointFit(
        found.models,
        found.sensor_covariance,
        residuals,
        adjusted - points,
        np.sqrt(squares / np.maximum(checked, MIN_REDUNDANCY)),
        checked,
    )


def projected_point_sigma(
    models: tuple[SensorModel, ...], points_mm: Array, sigma_mm: float
) -> Array:
    """Return the deviation of readings that the points' own uncertainty makes, (N, S) [px]."""
    jacobian = CameraStack.of(models).linearise(points_mm)[1]
    point_sigma: Array = sigma_mm * np.linalg.norm(jacobian, axis=2)
    return point_sigma


def _prior(fits: SensorFits) -> SensorPrior | None:
    """Return the prior of the offsets along the slits; None without any."""
    at_prior, information = [], []
    for row, model in enumerate(fits.models):
        diagonal = np.zeros(model.parameter_count)
        if model.distortion is not None:
            diagonal[PARAMETER_COUNT] = fits.lens_offsets.prior.sigma_mm[row] ** -2.0
            mean = float(fits.lens_offsets.prior.mean_mm[row])
            model = replace(model, distortion=replace(model.distortion, offset_y_mm=mean))
        at_prior.append(model)
        information.append(diagonal)
    if not any(diagonal.any() for diagonal in information):
        return None
    return SensorPrior(tuple(at_prior), np.diag(np.concatenate(information)))

"""Joint adjustment of all sensors and uncertain control points."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.data_snooping import redundancy
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.single_sensor.design_matrix import fitted_columns
from compute.calibration.single_sensor.sensor_fits import (
    ControlObservations,
    SensorFits,
    projected_point_sigma,
)
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import NoConvergence, UndeterminedParameters
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

MIN_REDUNDANCY: Final = 4.0
"""Smallest redundancy of a sensor from which its noise is estimated."""

MIN_NOISE_SHARES: Final = (0.0, 0.1, 0.3, 1.0)
"""Standard deviations of readings, relative to what the control points' uncertainty does to them,
that are tried one after the other as lower bounds."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """Jointly adjusted sensors and control points.

    Args:
        models: the S cameras.
        covariance: joint, shape (P, P), for the standard deviations as given; 0 for parameters that
            are not fitted.
        residuals_px: fitted minus measured readings at the adjusted points, shape (N, S) [px].
        shifts_mm: adjusted minus given points, shape (N, 3) [mm].
        sigma_px: standard deviations of the readings that were taken, those given or wider ones,
            shape (N, S) [px].
        sigma_ratio: each sensor's noise estimated from its residuals over the given, shape (S,).
        redundancy: sum of each sensor's redundancy numbers, shape (S,).
    """

    models: tuple[SensorModel, ...]
    covariance: Array
    residuals_px: Array
    shifts_mm: Array
    sigma_px: Array
    sigma_ratio: Array
    redundancy: Array


def adjust_control_points(
    observed: ControlObservations,
    fits: SensorFits,
    sigma_px: Array,
    position_sigma_mm: float,
    progress: Progress = no_progress,
    start: JointFit | None = None,
) -> JointFit:
    """Adjust all sensors and the control points jointly; each coordinate has a prior.

    An error of a control point shifts the readings of all sensors that see it, so that their
    parameters are correlated. Where readings are so much more precise than the points that the
    search does not converge, they count for the next larger of MIN_NOISE_SHARES of the points'
    uncertainty: the covariance is then too large rather than too small.

    Args:
        observed: control points and readings.
        fits: starting cameras, with the readings' weights and the lenses' prior.
        sigma_px: standard deviations of the readings, shape (N, S) [px].
        position_sigma_mm: standard deviation of each coordinate of the points [mm].
        progress: called with the fraction done and the stage.
        start: an adjustment with other standard deviations, from whose cameras and points the
            search starts; None: from the fitted cameras and the given points.

    Raises:
        NoConvergence: see ``adjust``.
        UndeterminedParameters: see ``adjust``.
    """
    point_sigma = projected_point_sigma(fits.models, observed.points_mm, position_sigma_mm)
    used = fits.used(observed)
    for share in MIN_NOISE_SHARES:
        # Readings much more precise than the points make a valley too narrow to follow.
        wide = np.maximum(sigma_px, share * np.nan_to_num(point_sigma))
        try:
            adjustment = _adjust(observed, fits, wide, position_sigma_mm, progress, start)
        except (NoConvergence, UndeterminedParameters):
            if share == MIN_NOISE_SHARES[-1]:
                raise
            continue
        break
    squares = np.where(used, wide / sigma_px, 0.0) ** 2
    widening = np.sqrt(squares.sum(axis=0) / used.sum(axis=0))
    return replace(adjustment, sigma_ratio=adjustment.sigma_ratio * widening)


def _adjust(
    observed: ControlObservations,
    fits: SensorFits,
    sigma_px: Array,
    position_sigma_mm: float,
    progress: Progress,
    start: JointFit | None,
) -> JointFit:
    points = observed.points_mm
    counts = fits.used(observed)
    poses = PoseSet.points(
        points if start is None else points + start.shifts_mm,
        np.where(counts, observed.readings_px, np.nan),
        np.where(counts, sigma_px / np.sqrt(np.where(counts, fits.weights, 1.0)), np.nan),
        points,
        np.broadcast_to(position_sigma_mm**2 * np.eye(3), (len(points), 3, 3)),
    )
    free = np.concatenate(
        [np.isin(np.arange(m.parameter_count), fitted_columns(m)) for m in fits.models]
    )
    models = fits.models if start is None else start.models
    adjustment = adjust(models, [poses], prior=_prior(fits), free=free, progress=progress)
    adjusted = adjustment.pose_sets[0].translation_mm
    residuals = CameraStack.of(adjustment.models).project(adjusted) - observed.readings_px
    share = redundancy(adjustment)[:, 0]
    squares = np.nansum(adjustment.residuals[0][:, 0] ** 2, axis=0)
    checked = share.sum(axis=0)
    return JointFit(
        adjustment.models,
        adjustment.sensor_covariance,
        residuals,
        adjusted - points,
        sigma_px,
        np.sqrt(squares / np.maximum(checked, MIN_REDUNDANCY)),
        checked,
    )


def _prior(fits: SensorFits) -> SensorPrior | None:
    """Return the prior of the lenses; None without distortion."""
    stack = CameraStack.of(fits.models)
    if not stack.has_distortion:
        return None
    mean, information = fits.prior.gaussian(stack)
    means = []
    for model, values in zip(fits.models, mean, strict=True):
        distortion = model.distortion
        if distortion is None:
            means.append(model)
            continue
        distortion = replace(
            distortion,
            coefficients=(0.0,) * len(distortion.terms),
            offset_y_mm=float(values[PARAMETER_COUNT]),
        )
        means.append(replace(model, principal_point_px=float(values[1]), distortion=distortion))
    diagonal = np.zeros(sum(model.parameter_count for model in fits.models))
    here = stack.parameter_mask
    diagonal[stack.parameter_index[here]] = information[here]
    return SensorPrior(tuple(means), np.diag(diagonal))

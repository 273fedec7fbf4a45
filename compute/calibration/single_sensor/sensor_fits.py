"""Fit of all sensors to exact control points: metric, with distortion, least squares or robust."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import Loss
from compute.calibration.single_sensor.camera_fit import (
    LensOffsets,
    minimise,
    minimise_with_distortion,
    start_with_terms,
)
from compute.calibration.single_sensor.design_matrix import check_determined
from compute.calibration.single_sensor.distortion_terms import free_parameters
from compute.calibration.single_sensor.metric_fit import fit_metric_cameras, metric_from_projective
from compute.calibration.single_sensor.projective_camera import ProjectiveCamera, normalisation
from compute.calibration.single_sensor.trimmed_least_squares import robust_starts
from compute.camera.field_distortion import Term
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import NoConvergence, TooFewPoints
from compute.robust_statistics import biweight, huber, mad_sigma

Array = NDArray[np.float64]

SIGMA_FLOOR_PX: Final = 1e-6
"""Smallest standard deviation estimated from residuals: exact data still leave rounding."""
INITIAL_SIGMA_PX: Final = 0.05
"""Standard deviation of readings that weighs the offsets' prior until residuals give one."""
MAX_REWEIGHTINGS: Final = 60
WEIGHT_TOLERANCE: Final = 1e-6
HUBER_ITERATIONS: Final = 8
STEPS_PER_REWEIGHTING: Final = 4


@dataclass(frozen=True, eq=False)
class ControlObservations:
    """Checked control points and their readings.

    Args:
        points_mm: shape (N, 3).
        readings_px: shape (N, S); NaN where not seen.
        sigma_px: standard deviations of the readings, shape (N, S); ones where not known.
        sigma_known: whether they are known.
        sensors: the S sensors.
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array
    sigma_known: bool
    sensors: tuple[SensorGeometry, ...]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which readings there are, shape (N, S)."""
        return np.isfinite(self.readings_px)

    @property
    def weights(self) -> Array:
        """1 / standard deviation, 0 where not seen, shape (N, S)."""
        return np.where(self.seen, 1.0 / self.sigma_px, 0.0)

    @property
    def pitch_um(self) -> list[float | None]:
        """The sensors' pixel pitches [um]."""
        return [sensor.pitch_um for sensor in self.sensors]


@dataclass(frozen=True, eq=False)
class SensorFits:
    """Fitted cameras.

    Args:
        models: the S cameras.
        weights: of the readings by a robust loss, shape (N, S); ones with a linear loss.
        lens_offsets: where the lenses lie along the slits.
    """

    models: tuple[SensorModel, ...]
    weights: Array
    lens_offsets: LensOffsets


def fit_undistorted(
    observed: ControlObservations, loss: Loss, initial_models: Sequence[SensorModel] | None = None
) -> tuple[tuple[SensorModel, ...], Array]:
    """Fit the seven metric parameters of each sensor.

    Args:
        observed: control points and readings.
        loss: "linear" or "robust".
        initial_models: cameras from which the search starts too; used with a linear loss only.

    Returns:
        The S cameras, and the weights of the readings, shape (N, S).

    Raises:
        DegeneratePoints, NoConvergence: see ``fit_metric_cameras``.
    """
    ones = np.ones(observed.readings_px.shape)
    if loss == "linear":
        found = fit_metric_cameras(
            observed.points_mm,
            observed.readings_px,
            observed.sigma_px,
            observed.sensors,
            initial_models,
        )
        return found, ones
    starts = tuple(_robust_start(observed, column) for column in range(len(observed.sensors)))
    models, weights = _reweight(observed, starts, None)
    _check_determined(observed, models, weights, None)
    return models, weights


def fit_distorted(
    observed: ControlObservations,
    undistorted: Sequence[SensorModel],
    terms: Sequence[tuple[Term, ...]],
    lens_offsets: LensOffsets,
    loss: Loss,
    weights: Array,
) -> SensorFits:
    """Fit the cameras with distortion terms, one set for each sensor.

    Args:
        observed: control points and readings.
        undistorted: the seven-parameter cameras, from which the fit starts.
        terms: the distortion terms of each sensor; an empty tuple for none.
        lens_offsets: where the lenses lie along the slits, with their prior.
        loss: "linear" or "robust".
        weights: of the readings with the undistorted cameras, shape (N, S).

    Returns:
        The fitted cameras, the readings' weights and the offsets.

    Raises:
        TooFewPoints: a sensor has fewer readings than parameters.
        DegeneratePoints: a combination of parameters is undetermined.
        NoConvergence: a search did not converge.
    """
    if not any(terms):
        return SensorFits(tuple(undistorted), weights, lens_offsets)
    for sensor, sensor_terms, rows in zip(observed.sensors, terms, observed.seen.T, strict=True):
        needed = free_parameters(sensor_terms)
        if rows.sum() < needed:
            raise TooFewPoints(
                f"sensor {sensor.name} saw {rows.sum()} control points; its {needed} parameters "
                f"with {len(sensor_terms)} distortion terms need at least {needed}; give more "
                "points, or take fewer terms",
                sensor=sensor.name,
                points=int(rows.sum()),
            )
    models = start_with_terms(undistorted, terms, lens_offsets)
    scaled = (
        lens_offsets
        if observed.sigma_known
        else lens_offsets.scaled(np.full(len(models), INITIAL_SIGMA_PX))
    )
    for iteration in range(2):
        if loss == "robust":
            models, weights = _reweight(observed, models, scaled, multi_start=iteration == 0)
        else:
            models = _minimise(
                observed, models, scaled, observed.weights, multi_start=iteration == 0
            )
        if iteration == 1:
            break
        # The first fit gives the principal distance with distortion and the readings' standard
        # deviation, which scales the prior.
        lens_offsets = lens_offsets.at(models, observed.pitch_um)
        models = start_with_terms(models, terms, lens_offsets)
        scaled = lens_offsets
        if not observed.sigma_known:
            scaled = lens_offsets.scaled(residual_sigma(observed, models, weights))
    _check_determined(observed, models, weights, scaled)
    return SensorFits(models, weights, scaled)


def residual_sigma(
    observed: ControlObservations, models: Sequence[SensorModel], weights: Array
) -> Array:
    """Estimate each sensor's reading noise from its residuals.

    Args:
        observed: control points and readings.
        models: the S fitted cameras.
        weights: of the readings, shape (N, S); 0: left out.

    Returns:
        Standard deviations, shape (S,) [px].
    """
    residuals = CameraStack.of(models).project(observed.points_mm) - observed.readings_px
    sigma = []
    for model, column, weight in zip(models, residuals.T, weights.T, strict=True):
        rows = np.isfinite(column) & (weight > 0.0)
        terms = () if model.distortion is None else model.distortion.terms
        dof = max(int(rows.sum()) - PARAMETER_COUNT - len(terms), 1)
        sigma.append(max(float(np.sqrt((column[rows] ** 2).sum() / dof)), SIGMA_FLOOR_PX))
    return np.array(sigma)


def _check_determined(
    observed: ControlObservations,
    models: Sequence[SensorModel],
    weights: Array,
    lens_offsets: LensOffsets | None,
) -> None:
    used = np.where(weights > 0.0, observed.weights, 0.0)
    sigma = None if lens_offsets is None else lens_offsets.prior.sigma_mm
    check_determined(models, observed.points_mm, used, sigma)


def _minimise(
    observed: ControlObservations,
    starts: Sequence[SensorModel],
    lens_offsets: LensOffsets | None,
    weights: Array,
    multi_start: bool = True,
) -> tuple[SensorModel, ...]:
    stack = CameraStack.of(starts)
    problem = stack, observed.points_mm, observed.readings_px, weights
    if lens_offsets is None or not stack.has_distortion:
        ended = minimise(*problem)
    else:
        ended = minimise_with_distortion(*problem, lens_offsets.prior, multi_start=multi_start)
    models = ended.cameras.models(starts)
    for column, (sensor, start) in enumerate(zip(observed.sensors, starts, strict=True)):
        if not ended.converged[column]:
            # Undetermined parameters explain the failure better than "did not converge".
            _check_determined(observed, models, weights, lens_offsets)
            count = 0 if start.distortion is None else len(start.distortion.terms)
            raise NoConvergence(
                f"sensor {sensor.name}: the search for its {PARAMETER_COUNT} parameters and "
                f"{count} distortion terms did not converge; look for wrong labels, spread "
                "the points over the field, or take fewer terms",
                sensor=sensor.name,
            )
    return models


def _reweight(
    observed: ControlObservations,
    starts: Sequence[SensorModel],
    lens_offsets: LensOffsets | None,
    multi_start: bool = True,
) -> tuple[tuple[SensorModel, ...], Array]:
    """Iteratively reweighted least squares with Tukey's biweight, until the weights settle.

    A multi-start fit of distortion begins with undistorted cameras, whose residuals are large
    everywhere: its first iterations take Huber's weights, which leave no reading out.
    """
    stack = CameraStack.of(starts)
    weights = np.zeros(observed.readings_px.shape)
    free = max(model.parameter_count for model in starts)
    prior = lens_offsets.prior if lens_offsets is not None and stack.has_distortion else None
    huber_iterations = 0 if prior is None or not multi_start else HUBER_ITERATIONS
    for iteration in range(MAX_REWEIGHTINGS):
        residuals = stack.project(observed.points_mm) - observed.readings_px
        used = observed.seen & np.isfinite(residuals)
        size = np.where(used, np.abs(residuals) * observed.weights, 0.0)
        scale = mad_sigma(size, used, free)
        # The known noise is the lower bound of its estimate; without it, rounding is.
        scale = np.maximum(scale, 1.0 if observed.sigma_known else SIGMA_FLOOR_PX)
        new = np.where(
            used, (huber if iteration < huber_iterations else biweight)(size / scale), 0.0
        )
        change = float(np.abs(new - weights).max())
        weights = new
        problem = observed.points_mm, observed.readings_px, observed.weights * np.sqrt(weights)
        if iteration == 0 and prior is not None and multi_start:
            stack = minimise_with_distortion(stack, *problem, prior).cameras
        else:
            stack = minimise(stack, *problem, prior, STEPS_PER_REWEIGHTING).cameras
        if change < WEIGHT_TOLERANCE and iteration > huber_iterations:
            break
    models = stack.models(starts)
    models = _minimise(
        observed, models, lens_offsets, observed.weights * np.sqrt(weights), multi_start=False
    )
    return models, np.where(observed.seen, weights, 1.0)


def _robust_start(observed: ControlObservations, column: int) -> SensorModel:
    """Return one sensor's camera of least trimmed squares."""
    rows = observed.seen[:, column]
    points, readings = observed.points_mm[rows], observed.readings_px[rows, column]
    camera = ProjectiveCamera.of(points, readings)
    theta = robust_starts(camera, readings, observed.sigma_px[rows, column], 1)[0]
    return metric_from_projective(
        theta,
        normalisation(points),
        camera.centre_px,
        camera.scale_px,
        observed.sensors[column],
        points.mean(axis=0),
    )

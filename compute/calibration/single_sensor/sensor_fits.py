"""All sensors of a device fitted to exact control points: metric, distorted, robust if asked."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import Loss
from compute.calibration.single_sensor.design_matrix import check_determined
from compute.calibration.single_sensor.distortion_fit import (
    LensOffsets,
    minimise_with_distortion,
    start_with_terms,
)
from compute.calibration.single_sensor.distortion_terms import free_parameters
from compute.calibration.single_sensor.levenberg_marquardt import minimise
from compute.calibration.single_sensor.m_estimators import biweight, huber, mad_sigma
from compute.calibration.single_sensor.metric_fit import fit_metric_cameras, metric_from_projective
from compute.calibration.single_sensor.normalised_dlt import normalisation
from compute.calibration.single_sensor.projective_camera import ProjectiveCamera
from compute.calibration.single_sensor.trimmed_least_squares import robust_starts
from compute.camera.field_distortion import Term
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import NoConvergence, TooFewPoints

Array = NDArray[np.float64]

SIGMA_FLOOR_PX: Final = 1e-6
"""Smallest deviation estimated from residuals: exact data still leave rounding."""
INITIAL_SIGMA_PX: Final = 0.05
"""Deviation of readings under which the offsets' prior counts before residuals show it."""
MAX_REWEIGHTINGS: Final = 60
WEIGHT_TOLERANCE: Final = 1e-6
HUBER_ITERATIONS: Final = 8
STEPS_PER_REWEIGHTING: Final = 4


@dataclass(frozen=True, eq=False)
class ControlObservations:
    """Control points and readings, checked.

    Args:
        points_mm: shape (N, 3).
        readings_px: shape (N, S); NaN where not seen.
        sigma_px: standard deviations, shape (N, S), ones where they are not known.
        sigma_known: whether they are.
        sensors: S geometries.
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
    """Fitted cameras and the weights that a robust loss left to the readings, (N, S), else ones."""

    models: tuple[SensorModel, ...]
    weights: Array
    lens_offsets: LensOffsets


def fit_undistorted(
    observed: ControlObservations, loss: Loss, near: Sequence[SensorModel] | None = None
) -> tuple[tuple[SensorModel, ...], Array]:
    """Fit seven parameters for each sensor; the cameras and the readings' weights (N, S).

    Raises:
        DegeneratePoints, NoConvergence: see ``fit_metric_cameras``.
    """
    ones = np.ones(observed.readings_px.shape)
    if loss == "linear":
        found = fit_metric_cameras(
            observed.points_mm, observed.readings_px, observed.sigma_px, observed.sensors, near
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
        observed: the readings.
        undistorted: where to start.
        terms: for each sensor; none for none.
        lens_offsets: where the slits lie.
        loss: "linear" or "robust".
        weights: of the readings with the undistorted cameras, shape (N, S).

    Raises:
        TooFewPoints: fewer readings of a sensor than its parameters.
        DegeneratePoints: they leave a combination of parameters open.
        NoConvergence: a search did not come to rest.
    """
    if not any(terms):
        return SensorFits(tuple(undistorted), weights, lens_offsets)
    for sensor, own, rows in zip(observed.sensors, terms, observed.seen.T, strict=True):
        needed = free_parameters(own)
        if rows.sum() < needed:
            raise TooFewPoints(
                f"sensor {sensor.name} saw {rows.sum()} control points; its {needed} parameters "
                f"with {len(own)} distortion terms need at least {needed}; give more points, or "
                "take fewer terms",
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
            models, weights = _reweight(observed, models, scaled, near=iteration > 0)
        else:
            models = _minimise(observed, models, scaled, observed.weights, near=iteration > 0)
        if iteration == 1:
            break
        # The first fit shows what was not known: the principal distance beside distortion, and
        # the deviation of readings, in which the prior counts.
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
    """Return each sensor's deviation as its residuals show it, shape (S,) [px]."""
    misfit = CameraStack.of(models).project(observed.points_mm) - observed.readings_px
    sigma = []
    for model, column, weight in zip(models, misfit.T, weights.T, strict=True):
        rows = np.isfinite(column) & (weight > 0.0)
        own = () if model.distortion is None else model.distortion.terms
        dof = max(int(rows.sum()) - PARAMETER_COUNT - len(own), 1)
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
    near: bool = False,
) -> tuple[SensorModel, ...]:
    stack = CameraStack.of(starts)
    given = stack, observed.points_mm, observed.readings_px, weights
    if lens_offsets is None or not stack.has_distortion:
        ended = minimise(*given)
    else:
        ended = minimise_with_distortion(*given, lens_offsets.prior, multi_start=not near)
    models = ended.cameras.models(starts)
    for column, (sensor, own) in enumerate(zip(observed.sensors, starts, strict=True)):
        if not ended.converged[column]:
            # First whether there is one camera: a search for none does not come to rest.
            _check_determined(observed, models, weights, lens_offsets)
            count = 0 if own.distortion is None else len(own.distortion.terms)
            raise NoConvergence(
                f"sensor {sensor.name}: the search for its {PARAMETER_COUNT} parameters and "
                f"{count} distortion terms did not come to rest; look for wrong labels, spread "
                "the points over the field, or take fewer terms",
                sensor=sensor.name,
            )
    return models


def _reweight(
    observed: ControlObservations,
    starts: Sequence[SensorModel],
    lens_offsets: LensOffsets | None,
    near: bool = False,
) -> tuple[tuple[SensorModel, ...], Array]:
    """Iterate between cameras and the readings' biweights until these stay.

    With distortion the start is undistorted, unless it is near, and misfits all over: the first
    turns take Huber's weights, which leave none out.
    """
    stack = CameraStack.of(starts)
    weights = np.zeros(observed.readings_px.shape)
    free = max(model.parameter_count for model in starts)
    prior = lens_offsets.prior if lens_offsets is not None and stack.has_distortion else None
    huber_iterations = 0 if prior is None or near else HUBER_ITERATIONS
    for iteration in range(MAX_REWEIGHTINGS):
        misfit = stack.project(observed.points_mm) - observed.readings_px
        used = observed.seen & np.isfinite(misfit)
        size = np.where(used, np.abs(misfit) * observed.weights, 0.0)
        scale = mad_sigma(size, used, free)
        # Noise that is known bounds what is taken for it from below, else rounding.
        scale = np.maximum(scale, 1.0 if observed.sigma_known else SIGMA_FLOOR_PX)
        new = np.where(
            used, (huber if iteration < huber_iterations else biweight)(size / scale), 0.0
        )
        change = float(np.abs(new - weights).max())
        weights = new
        given = observed.points_mm, observed.readings_px, observed.weights * np.sqrt(weights)
        if iteration == 0 and prior is not None and not near:
            stack = minimise_with_distortion(stack, *given, prior).cameras
        else:
            stack = minimise(stack, *given, prior, STEPS_PER_REWEIGHTING).cameras
        if change < WEIGHT_TOLERANCE and iteration > huber_iterations:
            break
    models = stack.models(starts)
    models = _minimise(
        observed, models, lens_offsets, observed.weights * np.sqrt(weights), near=True
    )
    return models, np.where(observed.seen, weights, 1.0)


def _robust_start(observed: ControlObservations, column: int) -> SensorModel:
    """Return the camera of least trimmed squares of one sensor."""
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

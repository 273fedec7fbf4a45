"""All sensors of a device fitted to exact control points: metric, distorted, robust if asked."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.design import check_determined
from compute.calibration.distorted import Slits, minimise_distorted, with_terms
from compute.calibration.labels.projective import ProjectiveCamera
from compute.calibration.labels.robust import robust_starts
from compute.calibration.levenberg import minimise
from compute.calibration.linear import normalisation
from compute.calibration.metric import fit_metric, model_of_projective
from compute.calibration.robust import biweight, huber, scale_of
from compute.calibration.settings import Loss
from compute.calibration.terms import free_parameters
from compute.camera.field_distortion import Term
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import NoConvergence, TooFewPoints

Array = NDArray[np.float64]

SIGMA_FLOOR_PX: Final = 1e-6
"""Smallest deviation estimated from residuals: exact data still leave rounding."""
FIRST_SIGMA_PX: Final = 0.05
"""Deviation of readings under which the offsets' prior counts before residuals show it."""
REWEIGHTINGS: Final = 60
SETTLED_WEIGHT: Final = 1e-6
GENTLE_TURNS: Final = 8
STEPS_A_TURN: Final = 4


@dataclass(frozen=True, eq=False)
class Observed:
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
    slits: Slits


def fit_undistorted(
    observed: Observed, loss: Loss, near: Sequence[SensorModel] | None = None
) -> tuple[tuple[SensorModel, ...], Array]:
    """Fit seven parameters for each sensor; the cameras and the readings' weights (N, S).

    Raises:
        DegeneratePoints, NoConvergence: see ``fit_metric``.
    """
    ones = np.ones(observed.readings_px.shape)
    if loss == "linear":
        found = fit_metric(
            observed.points_mm, observed.readings_px, observed.sigma_px, observed.sensors, near
        )
        return found, ones
    starts = tuple(_robust_start(observed, column) for column in range(len(observed.sensors)))
    models, weights = _reweighted(observed, starts, None)
    _check(observed, models, weights, None)
    return models, weights


def fit_distorted(
    observed: Observed,
    undistorted: Sequence[SensorModel],
    terms: Sequence[tuple[Term, ...]],
    slits: Slits,
    loss: Loss,
    weights: Array,
) -> SensorFits:
    """Fit the cameras with distortion terms, one set for each sensor.

    Args:
        observed: the readings.
        undistorted: where to start.
        terms: for each sensor; none for none.
        slits: where the slits lie.
        loss: "linear" or "robust".
        weights: of the readings with the undistorted cameras, shape (N, S).

    Raises:
        TooFewPoints: fewer readings of a sensor than its parameters.
        DegeneratePoints: they leave a combination of parameters open.
        NoConvergence: a search did not come to rest.
    """
    if not any(terms):
        return SensorFits(tuple(undistorted), weights, slits)
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
    models = with_terms(undistorted, terms, slits)
    scaled = slits if observed.sigma_known else slits.scaled(np.full(len(models), FIRST_SIGMA_PX))
    for turn in range(2):
        if loss == "robust":
            models, weights = _reweighted(observed, models, scaled, near=turn > 0)
        else:
            models = _minimised(observed, models, scaled, observed.weights, near=turn > 0)
        if turn == 1:
            break
        # The first fit shows what was not known: the principal distance beside distortion, and
        # the deviation of readings, in which the prior counts.
        slits = slits.at(models, observed.pitch_um)
        models = with_terms(models, terms, slits)
        scaled = slits
        if not observed.sigma_known:
            scaled = slits.scaled(residual_sigma(observed, models, weights))
    _check(observed, models, weights, scaled)
    return SensorFits(models, weights, scaled)


def residual_sigma(observed: Observed, models: Sequence[SensorModel], weights: Array) -> Array:
    """Return each sensor's deviation as its residuals show it, shape (S,) [px]."""
    misfit = CameraStack.of(models).project(observed.points_mm) - observed.readings_px
    sigma = []
    for model, column, weight in zip(models, misfit.T, weights.T, strict=True):
        rows = np.isfinite(column) & (weight > 0.0)
        own = () if model.distortion is None else model.distortion.terms
        freedom = max(int(rows.sum()) - PARAMETER_COUNT - len(own), 1)
        sigma.append(max(float(np.sqrt((column[rows] ** 2).sum() / freedom)), SIGMA_FLOOR_PX))
    return np.array(sigma)


def _check(
    observed: Observed, models: Sequence[SensorModel], weights: Array, slits: Slits | None
) -> None:
    used = np.where(weights > 0.0, observed.weights, 0.0)
    sigma = None if slits is None else slits.prior.sigma_mm
    check_determined(models, observed.points_mm, used, sigma)


def _minimised(
    observed: Observed,
    starts: Sequence[SensorModel],
    slits: Slits | None,
    weights: Array,
    near: bool = False,
) -> tuple[SensorModel, ...]:
    stack = CameraStack.of(starts)
    given = stack, observed.points_mm, observed.readings_px, weights
    if slits is None or not stack.distorted:
        ended = minimise(*given)
    else:
        ended = minimise_distorted(*given, slits.prior, several=not near)
    models = ended.cameras.models(starts)
    for column, (sensor, own) in enumerate(zip(observed.sensors, starts, strict=True)):
        if not ended.settled[column]:
            # First whether there is one camera: a search for none does not come to rest.
            _check(observed, models, weights, slits)
            count = 0 if own.distortion is None else len(own.distortion.terms)
            raise NoConvergence(
                f"sensor {sensor.name}: the search for its {PARAMETER_COUNT} parameters and "
                f"{count} distortion terms did not come to rest; look for wrong labels, spread "
                "the points over the field, or take fewer terms",
                sensor=sensor.name,
            )
    return models


def _reweighted(
    observed: Observed,
    starts: Sequence[SensorModel],
    slits: Slits | None,
    near: bool = False,
) -> tuple[tuple[SensorModel, ...], Array]:
    """Iterate between cameras and the readings' biweights until these stay.

    With distortion the start is undistorted, unless it is near, and misfits all over: the first
    turns take Huber's weights, which leave none out.
    """
    stack = CameraStack.of(starts)
    weights = np.zeros(observed.readings_px.shape)
    free = max(model.parameter_count for model in starts)
    prior = slits.prior if slits is not None and stack.distorted else None
    gentle = 0 if prior is None or near else GENTLE_TURNS
    for turn in range(REWEIGHTINGS):
        misfit = stack.project(observed.points_mm) - observed.readings_px
        used = observed.seen & np.isfinite(misfit)
        size = np.where(used, np.abs(misfit) * observed.weights, 0.0)
        scale = scale_of(size, used, free)
        # Noise that is known bounds what is taken for it from below, else rounding.
        scale = np.maximum(scale, 1.0 if observed.sigma_known else SIGMA_FLOOR_PX)
        new = np.where(used, (huber if turn < gentle else biweight)(size / scale), 0.0)
        change = float(np.abs(new - weights).max())
        weights = new
        given = observed.points_mm, observed.readings_px, observed.weights * np.sqrt(weights)
        if turn == 0 and prior is not None and not near:
            stack = minimise_distorted(stack, *given, prior).cameras
        else:
            stack = minimise(stack, *given, prior, STEPS_A_TURN).cameras
        if change < SETTLED_WEIGHT and turn > gentle:
            break
    models = stack.models(starts)
    models = _minimised(observed, models, slits, observed.weights * np.sqrt(weights), near=True)
    return models, np.where(observed.seen, weights, 1.0)


def _robust_start(observed: Observed, column: int) -> SensorModel:
    """Return the camera of least trimmed squares of one sensor."""
    rows = observed.seen[:, column]
    points, readings = observed.points_mm[rows], observed.readings_px[rows, column]
    camera = ProjectiveCamera.of(points, readings)
    theta = robust_starts(camera, readings, observed.sigma_px[rows, column], 1)[0]
    return model_of_projective(
        theta,
        normalisation(points),
        camera.middle_px,
        camera.scale_px,
        observed.sensors[column],
        points.mean(axis=0),
    )

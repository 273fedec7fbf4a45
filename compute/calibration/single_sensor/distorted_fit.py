"""Fit of cameras with given distortion terms: least squares or robust."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import WEAK_STRENGTH, Loss, free_parameters
from compute.calibration.single_sensor.camera_fit import (
    MinimisationResult,
    minimise_with_distortion,
)
from compute.calibration.single_sensor.design_matrix import (
    check_determined,
)
from compute.calibration.single_sensor.lens_prior import (
    LensPrior,
    start_with_terms,
    weak_parameters,
)
from compute.calibration.single_sensor.sensor_fits import (
    SIGMA_FLOOR_PX,
    ControlObservations,
    SensorFits,
    refit,
    residual_sigma,
)
from compute.calibration.single_sensor.trimmed_least_squares import (
    covered_readings,
    trimmed_distorted_cameras,
)
from compute.camera.field_distortion import Term
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, NoConvergence, TooFewPoints
from compute.robust_statistics import biweight, biweight_loss, mad_sigma

Array = NDArray[np.float64]

INITIAL_SIGMA_PX: Final = 0.05
"""Standard deviation of readings that weighs the offsets' prior until residuals give one."""
MAX_REWEIGHTINGS: Final = 60
SETTLED_WEIGHTS: Final = 1e-3
MAX_SUBSET_READINGS: Final = 60
"""Readings of a sensor up to which a robust fit starts from subsets as well: more show wrong
readings beside tens of pixels of distortion by themselves."""
_MAX_SUBSET_POINTS: Final = 4 * MAX_SUBSET_READINGS
"""And control points: each costs as much, whether the sensor saw it or not."""
USUAL_STRENGTH: Final = 0.03
"""Share of half the field by which usual lenses distort at the field's edge, for the choice of
wrong readings: that of a wide lens. Three times as much costs less than one wrong reading."""
MIN_REDUNDANCY: Final = 0.01
"""Smallest share of a reading's variance that is taken to be left in its residual."""


def fit_distorted(
    observed: ControlObservations,
    undistorted: SensorFits,
    terms: Sequence[tuple[Term, ...]],
    loss: Loss,
    *,
    from_subsets: bool = False,
) -> SensorFits:
    """Fit the cameras with distortion terms, one set for each sensor.

    Args:
        observed: control points and readings.
        undistorted: the seven-parameter cameras, from which the fit starts.
        terms: the distortion terms of each sensor; an empty tuple for none.
        loss: "linear" or "robust".
        from_subsets: a robust fit of few readings starts also from cameras of random subsets:
            distortion of tens of pixels hides wrong readings from cameras without distortion.

    Raises:
        TooFewPoints: a sensor has fewer readings than parameters.
        DegeneratePoints: a combination of parameters is undetermined.
        NoConvergence: a search did not converge.
    """
    if not any(terms):
        return undistorted
    for sensor, sensor_terms, rows in zip(
        observed.sensors, terms, observed.observed_mask.T, strict=True
    ):
        needed = free_parameters(sensor_terms)
        if rows.sum() < needed:
            raise TooFewPoints(
                f"sensor {sensor.name} saw {rows.sum()} control points; its {needed} parameters "
                f"with {len(sensor_terms)} distortion terms need at least {needed}; give more "
                "points, or take fewer terms",
                sensor=sensor.name,
                points=int(rows.sum()),
            )
    if loss == "linear":
        return _fit_weighted(observed, undistorted, terms, multi_start=True)
    fewest = int(observed.observed_mask.sum(axis=0).min())
    few = fewest <= MAX_SUBSET_READINGS and len(observed.points_mm) <= _MAX_SUBSET_POINTS
    if not (from_subsets and few):
        return _fit_robustly(observed, undistorted, terms)
    start = _usual_lenses(observed, undistorted, terms)
    return _fit_weighted(observed, start, terms, multi_start=False)


def _fit_weighted(
    observed: ControlObservations,
    start: SensorFits,
    terms: Sequence[tuple[Term, ...]],
    *,
    multi_start: bool,
) -> SensorFits:
    """Fit cameras with terms to readings of given weights; see ``minimise_with_distortion``."""
    models, prior, unit = start.models, start.prior, None
    weighted = observed.weights * np.sqrt(start.weights)
    for first in (True, False):
        models = start_with_terms(models, terms, prior)
        unit = _unit(observed, models, start.weights, first)
        scaled = prior if unit is None else prior.scaled(unit)
        models = refit(observed, models, scaled, weighted, multi_start and first)
        # The first fit gives the principal distance with distortion, and the noise.
        prior = prior.at(models, observed.pitch_um)
    return _checked(observed, SensorFits(models, start.weights, prior, unit))


def _fit_robustly(
    observed: ControlObservations, start: SensorFits, terms: Sequence[tuple[Term, ...]]
) -> SensorFits:
    """Fit cameras with terms to reweighted readings, from given cameras and weights."""
    models, weights, prior, unit = start.models, start.weights, start.prior, None
    for first in (True, False):
        models = start_with_terms(models, terms, prior)
        unit = _unit(observed, models, weights, first)
        scaled = prior if unit is None else prior.scaled(unit)
        models, weights = _reweight_distorted(observed, models, scaled, weights, first)
        prior = prior.at(models, observed.pitch_um)
    return _checked(observed, SensorFits(models, weights, prior, unit))


def _unit(
    observed: ControlObservations, models: Sequence[SensorModel], weights: Array, first: bool
) -> Array | None:
    """Return the noise that a weight of 1 stands for, shape (S,) [px]; None: it is known."""
    if observed.sigma_known:
        return None
    if first:
        return np.full(len(models), INITIAL_SIGMA_PX)
    return residual_sigma(observed, models, weights)


def _checked(observed: ControlObservations, fits: SensorFits) -> SensorFits:
    weights = fits.known_weights(observed)
    check_determined(fits.models, observed.points_mm, weights, fits.scaled_prior)
    return fits


def _usual_lenses(
    observed: ControlObservations, undistorted: SensorFits, terms: Sequence[tuple[Term, ...]]
) -> SensorFits:
    """Return cameras and weights of a robust fit of lenses that distort as much as usual.

    Lenses as free as the terms asked for agree with some of few wrong readings. The search starts
    from the cameras without distortion, from which tens of pixels of distortion hide wrong
    readings, and from those of random subsets; the lower loss wins.
    """
    prior = undistorted.prior
    prior = prior.with_strength(USUAL_STRENGTH * prior.strength / WEAK_STRENGTH)
    usual = replace(undistorted, prior=prior)
    starts = start_with_terms(usual.models, terms, prior)
    scaled = prior
    if not observed.sigma_known:
        scaled = prior.scaled(np.full(len(starts), INITIAL_SIGMA_PX))
    cameras, weights = trimmed_distorted_cameras(
        CameraStack.of(starts), observed.points_mm, observed.readings_px, observed.weights, scaled
    )
    majority = replace(usual, models=cameras.models(starts), weights=weights)
    found = []
    for start in (usual, majority):
        try:
            fits = _fit_robustly(observed, start, terms)
        except (DegeneratePoints, NoConvergence) as error:
            failure = error
            continue
        found.append((_losses(observed, fits), fits))
    if not found:
        raise failure
    best = np.argmin([losses for losses, _ in found], axis=0).tolist()
    models = tuple(found[k][1].models[column] for column, k in enumerate(best))
    columns = [found[k][1].weights[:, column] for column, k in enumerate(best)]
    return replace(undistorted, models=models, weights=np.stack(columns, axis=1))


def _losses(observed: ControlObservations, fits: SensorFits) -> Array:
    """Return each sensor's loss, shape (S,), by which robust fits of the same readings compare.

    Tukey's, with the prior's, where the noise is known; otherwise the trimmed sum of squares, which
    needs none.
    """
    cameras = CameraStack.of(fits.models)
    residuals = np.where(observed.observed_mask, observed.residuals_px(cameras), 0.0)
    # NaN: behind the lens.
    size = np.where(np.isfinite(residuals), np.abs(residuals) / observed.sigma_px, np.inf)
    if not observed.sigma_known:
        size = np.sort(np.where(observed.observed_mask, size, np.inf), axis=0)
        kept = np.arange(len(size))[:, None] < covered_readings(observed.observed_mask)
        return np.asarray((np.where(kept, size, 0.0) ** 2).sum(axis=0))
    mean, information = fits.prior.gaussian(cameras)
    penalty = (information * (weak_parameters(cameras) - mean) ** 2).sum(axis=1)
    return np.asarray(biweight_loss(size).sum(axis=0) + 0.5 * penalty)


def _reweight_distorted(
    observed: ControlObservations,
    starts: Sequence[SensorModel],
    prior: LensPrior,
    weights: Array,
    multi_start: bool,
) -> tuple[tuple[SensorModel, ...], Array]:
    """Fit cameras with distortion to reweighted readings, until the weights settle.

    Args:
        observed: control points and readings.
        starts: S cameras with their terms.
        prior: of the lenses, in units of the readings' weights.
        weights: those to begin with, shape (N, S).
        multi_start: see ``minimise_with_distortion``; the noise then counts as unknown, since
            cameras that are far from the solution leave more of it.
    """
    stack = CameraStack.of(starts)
    min_scale = 1.0 if observed.sigma_known and not multi_start else SIGMA_FLOOR_PX
    for iteration in range(MAX_REWEIGHTINGS):
        solution = minimise_with_distortion(
            stack,
            observed.points_mm,
            observed.readings_px,
            observed.weights * np.sqrt(weights),
            prior,
            multi_start=multi_start and iteration == 0,
        )
        stack = solution.cameras
        new = studentised_weights(observed, solution, weights, observed.sigma_px, min_scale)
        if np.abs(new - weights).max() < SETTLED_WEIGHTS:
            break
        weights = new
    weighted = observed.weights * np.sqrt(weights)
    models = refit(observed, stack.models(starts), prior, weighted, multi_start=False)
    return models, weights


def studentised_weights(
    observed: ControlObservations,
    solution: MinimisationResult,
    weights: Array,
    sigma_px: Array,
    min_scale: float | Array,
) -> Array:
    """Return Tukey's weights of the readings by their distance from fitted cameras, shape (N, S).

    The distance counts in its own standard deviation, that of a residual where the reading
    counts, of a prediction where it does not (Baarda's data snooping): few readings leave small
    residuals even of wrong ones, and cameras far from the others are unsure.

    Args:
        observed: control points and readings.
        solution: the search that fitted S cameras.
        weights: with which it did, shape (N, S).
        sigma_px: the readings' standard deviations, shape (N, S) [px].
        min_scale: smallest ratio of the residuals to these, one or shape (S,).
    """
    fitted, jacobian = solution.cameras.project_with_parameter_jacobian(observed.points_mm)
    seen = observed.observed_mask & np.isfinite(fitted)
    jacobian = np.nan_to_num(jacobian)
    leverage = np.einsum("nsp,spq,nsq->ns", jacobian, solution.cofactors, jacobian, optimize=True)
    variance = 1.0 + (1.0 - 2.0 * weights) * leverage / sigma_px**2
    distance = np.where(seen, np.abs(fitted - observed.readings_px), 0.0)
    distance /= sigma_px * np.sqrt(np.maximum(variance, MIN_REDUNDANCY))
    scale = np.maximum(mad_sigma(distance, seen, 0), min_scale)
    return np.where(observed.observed_mask, np.where(seen, biweight(distance / scale), 0.0), 1.0)

"""Distortion of a device's lenses when its size is not known: a hierarchical fit.

The lenses of one device are alike: their coefficients share one scale, the strength of
``LensPrior``. Its posterior follows from the evidence of all sensors' readings together; terms that
the readings do not determine stay near 0, with the prior's own variance in the covariance. No set
of terms is chosen, so that few readings need no other method than many.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import DistortionEstimate
from compute.calibration.settings import Loss, preset_terms
from compute.calibration.single_sensor.camera_fit import (
    MAX_ITERATIONS,
    MinimisationResult,
    minimise,
)
from compute.calibration.single_sensor.design_matrix import effective_parameters
from compute.calibration.single_sensor.distorted_fit import SETTLED_WEIGHTS, studentised_weights
from compute.calibration.single_sensor.lens_prior import LensPrior, start_with_terms
from compute.calibration.single_sensor.reading_noise import estimate_noise
from compute.calibration.single_sensor.sensor_fits import (
    SIGMA_FLOOR_PX,
    ControlObservations,
    SensorFits,
    check_converged,
)
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

AUTO_TERMS: Final = preset_terms("all-5")
"""Terms of a lens about which nothing is known."""
STRENGTHS: Final = np.array([1e-5, 3e-4, 1e-3, 2e-3, 4e-3, 8e-3, 1.6e-2, 3.2e-2])
"""Strengths of the prior, equally probable beforehand: from no distortion, 0.01 px at the edge of
2048 pixels, to a wide lens's."""
NOISE_ITERATIONS: Final = 3
NOISE_TOLERANCE: Final = 0.05
MIN_DOF: Final = 1e-3
"""Smallest degrees of freedom of a sensor's residuals, for rounding."""
MAX_REWEIGHTINGS: Final = 30
FINAL_ITERATIONS: Final = 10 * MAX_ITERATIONS
"""Largest number of trial steps of the last fit. Few readings leave flat, curved valleys, along
which the sum of squares falls by thousandths for a thousand steps."""
NO_DISTORTION_LOG_RATIO: Final = 3.0
"""Natural logarithm of the ratio of evidence from which distortion counts as shown: 20 to 1."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Fits of S sensors with each of G strengths, and the strengths' posterior.

    Args:
        solution: G S cameras, the first strength's first.
        log_evidence: of all sensors together, shape (G,), up to a constant.
        information: the priors', shape (G S, W).
        noise_px: of the readings, with each strength another, shape (G, S) [px]; None: known.
        sigma_px: the readings' standard deviations, shape (N, G S) [px].
    """

    solution: MinimisationResult
    log_evidence: Array
    information: Array
    noise_px: Array | None
    sigma_px: Array

    @property
    def probability(self) -> Array:
        """Posterior of the strengths, shape (G,).

        The lenses of a device are neither independent draws of the scale nor copies of one draw,
        where S lenses would tell of it as much as one: their evidence counts as that of sqrt(S)
        lenses. Their product is too sure of a scale, and of no distortion first of all; their mean
        makes the covariance of devices with few readings too large (``reproduce random-rigs``).
        """
        lenses = len(self.information) // len(self.log_evidence)
        weight = np.exp((self.log_evidence - self.log_evidence.max()) / np.sqrt(lenses))
        return np.asarray(weight / weight.sum())


def fit_distortion_scale(
    observed: ControlObservations,
    undistorted: SensorFits,
    loss: Loss,
    point_sigma_px: Array | None = None,
    progress: Progress = no_progress,
) -> tuple[SensorFits, DistortionEstimate]:
    """Fit distortion whose scale is common to all lenses and estimated from the readings.

    The evidence of each strength is Laplace's approximation (MacKay,
    doi:10.1162/neco.1992.4.3.415), see ``_Grid.probability``. The cameras are those of the
    posterior mean of the strength's square, which averages the prior's variance.

    Args:
        observed: control points and readings.
        undistorted: the seven-parameter cameras.
        loss: "linear" or "robust".
        point_sigma_px: what the control points' uncertainty adds to the readings, shape (N, S)
            [px], where the readings' standard deviations are not known; None: nothing.
        progress: called with the fraction done and the stage.

    Returns:
        The fits, and the distortion's scale in figures and words.

    Raises:
        NoConvergence: a search did not converge.
    """
    if loss == "robust" and observed.sigma_known:
        # Where the noise is known, wrong readings ask for a lens that distorts as they do.
        unknown = replace(observed, sigma_known=False)
        first = _fit_scale(unknown, undistorted, loss, point_sigma_px, progress)[0]
        undistorted = replace(undistorted, weights=first.weights)
    fits, solution, estimate = _fit_scale(observed, undistorted, loss, point_sigma_px, progress)
    check_converged(observed, fits.models, solution.converged)
    progress(1.0, "scale of the distortion")
    return fits, estimate


def _fit_scale(
    observed: ControlObservations,
    undistorted: SensorFits,
    loss: Loss,
    point_sigma_px: Array | None,
    progress: Progress,
) -> tuple[SensorFits, MinimisationResult, DistortionEstimate]:
    """Fit as ``fit_distortion_scale``, from the weights of the undistorted cameras."""
    sensors = len(undistorted.models)
    starts = start_with_terms(undistorted.models, (AUTO_TERMS,) * sensors, undistorted.prior)
    cameras = CameraStack.of(starts).rows(np.tile(np.arange(sensors), len(STRENGTHS)))
    noise = None
    if not observed.sigma_known:
        noise = np.tile(_first_noise(observed, undistorted), (len(STRENGTHS), 1))
    weights = undistorted.weights
    for _ in range(1 if loss == "linear" else MAX_REWEIGHTINGS):
        grid = _fit_grid_and_noise(
            observed, cameras, undistorted.prior, weights, noise, point_sigma_px, progress
        )
        strength, fits, solution = _fit_mean_strength(
            observed, starts, undistorted.prior, grid, weights, point_sigma_px
        )
        if loss == "linear":
            break
        sigma = _total_sigma(observed, fits.unit_px, point_sigma_px)
        # The known noise is the lower bound of its estimate; without it, rounding is.
        min_scale = 1.0 if fits.unit_px is None else SIGMA_FLOOR_PX / fits.unit_px
        new = studentised_weights(observed, solution, weights, sigma, min_scale)
        if np.abs(new - weights).max() < SETTLED_WEIGHTS:
            break
        weights, cameras, noise = new, grid.solution.cameras, grid.noise_px
    return fits, solution, _describe(grid, strength, undistorted.models)


def _fit_mean_strength(
    observed: ControlObservations,
    with_terms: Sequence[SensorModel],
    prior: LensPrior,
    grid: _Grid,
    weights: Array,
    point_sigma_px: Array | None,
) -> tuple[float, SensorFits, MinimisationResult]:
    """Return the posterior mean strength, its cameras, and the search that found them."""
    probability = grid.probability
    strength = float(np.sqrt(probability @ STRENGTHS**2))
    noise = None if grid.noise_px is None else np.sqrt(probability @ grid.noise_px**2)
    sigma = _total_sigma(observed, noise, point_sigma_px)
    sensors = len(with_terms)
    nearest = int(np.abs(np.log(STRENGTHS / strength)).argmin())
    rows = np.arange(nearest * sensors, (nearest + 1) * sensors)
    models = grid.solution.cameras.rows(rows).models(with_terms)
    prior = prior.with_strength(strength).at(models, observed.pitch_um)
    starts = start_with_terms(models, (AUTO_TERMS,) * sensors, prior)
    solution = minimise(
        CameraStack.of(starts),
        observed.points_mm,
        observed.readings_px,
        np.where(observed.observed_mask, np.sqrt(weights) / sigma, 0.0),
        prior,
        FINAL_ITERATIONS,
        variance=1.0,
    )
    return strength, SensorFits(solution.cameras.models(starts), weights, prior, noise), solution


def _first_noise(observed: ControlObservations, undistorted: SensorFits) -> Array:
    """Return the noise to begin with, shape (S,) [px]: residuals of cameras without distortion."""
    residuals = np.abs(
        np.where(observed.observed_mask, observed.residuals_px(undistorted.models), np.nan)
    )
    return np.asarray(np.maximum(np.nanmedian(residuals, axis=0), 0.05))


def _total_sigma(
    observed: ControlObservations, noise: Array | None, point_sigma_px: Array | None
) -> Array:
    if noise is None:
        return observed.sigma_px
    total = np.broadcast_to(noise, observed.sigma_px.shape)
    return np.asarray(total if point_sigma_px is None else np.hypot(total, point_sigma_px))


def _fit_grid_and_noise(
    observed: ControlObservations,
    cameras: CameraStack,
    prior: LensPrior,
    weights: Array,
    noise_px: Array | None,
    point_sigma_px: Array | None,
    progress: Progress,
) -> _Grid:
    """Fit cameras with each strength, and estimate the noise of each fit from its residuals.

    Noise to begin with, shape (G, S) [px]; None: known.
    """
    if noise_px is None:
        return _fit_grid(observed, cameras, prior, weights, None, None)
    noise = noise_px
    for iteration in range(NOISE_ITERATIONS):
        progress(iteration / (NOISE_ITERATIONS + 1), "scale of the distortion")
        grid = _fit_grid(observed, cameras, prior, weights, noise, point_sigma_px)
        cameras = grid.solution.cameras
        last = noise
        grid, noise = _integrate_noise(observed, grid, weights, point_sigma_px)
        if np.abs(noise / last - 1.0).max() < NOISE_TOLERANCE:
            break
    return grid


def _fit_grid(
    observed: ControlObservations,
    cameras: CameraStack,
    prior: LensPrior,
    weights: Array,
    noise_px: Array | None,
    point_sigma_px: Array | None,
) -> _Grid:
    """Fit cameras with each strength; noise of shape (G, S) [px], None: known."""
    sensors, count = len(prior.strength), len(STRENGTHS)
    index = np.tile(np.arange(sensors), count)
    if noise_px is None:
        sigma = observed.sigma_px[:, index]
    else:
        sigma = np.broadcast_to(noise_px.ravel(), (len(observed.points_mm), len(index)))
        if point_sigma_px is not None:
            sigma = np.hypot(sigma, point_sigma_px[:, index])
    used = (observed.observed_mask & (weights > 0.0))[:, index]
    priors = prior.rows(index).with_strength(np.repeat(STRENGTHS, sensors))
    solution = minimise(
        cameras,
        observed.points_mm,
        observed.readings_px[:, index],
        np.where(used, np.sqrt(weights)[:, index] / sigma, 0.0),
        priors,
        variance=1.0,
    )
    information = priors.gaussian(cameras)[1]
    diagonal = np.arange(cameras.width)
    scale = np.sqrt(solution.normal[:, diagonal, diagonal])
    unit = solution.normal / (scale[:, :, None] * scale[:, None, :])
    log_determinant = np.linalg.slogdet(unit)[1] + 2.0 * np.log(scale).sum(axis=1)
    log_prior = np.log(information[:, PARAMETER_COUNT + 1 :]).sum(axis=1)
    log_evidence = 0.5 * (log_prior - solution.squares - log_determinant)
    log_evidence -= np.where(used, np.log(sigma), 0.0).sum(axis=0)
    log_evidence = np.where(np.isfinite(log_evidence), log_evidence, -np.inf)
    log_evidence = log_evidence.reshape(count, sensors).sum(axis=1)
    return _Grid(solution, log_evidence, information, noise_px, sigma)


def _integrate_noise(
    observed: ControlObservations, grid: _Grid, weights: Array, point_sigma_px: Array | None
) -> tuple[_Grid, Array]:
    """Return the grid with its evidence integrated over the noise, and the noise, (G, S) [px].

    The residuals and their degrees of freedom stay those of the noise with which it was fitted.
    """
    count = len(STRENGTHS)
    sensors = observed.readings_px.shape[1]
    index = np.tile(np.arange(sensors), count)
    used = (observed.observed_mask & (weights > 0.0))[:, index]
    residuals = grid.solution.cameras.project(observed.points_mm) - observed.readings_px[:, index]
    residuals = np.where(used, residuals * np.sqrt(weights)[:, index], 0.0)
    dof = used.sum(axis=0) - effective_parameters(grid.solution.cofactors, grid.information)
    dof = np.maximum(dof, MIN_DOF)
    share = dof / np.maximum(used.sum(axis=0), 1)
    logarithms = np.where(used, np.log(grid.sigma_px), 0.0).sum(axis=0)
    here = -share * logarithms - 0.5 * ((residuals / grid.sigma_px) ** 2).sum(axis=0)
    noise, log_evidence = np.empty((count, sensors)), grid.log_evidence.copy()
    for row in range(count):
        part = slice(row * sensors, (row + 1) * sensors)
        estimate = estimate_noise(residuals[:, part], used[:, part], dof[part], point_sigma_px)
        noise[row] = estimate.sigma_px
        log_evidence[row] += estimate.log_evidence - here[part].sum()
    return replace(grid, noise_px=noise, log_evidence=log_evidence), noise


def _describe(grid: _Grid, strength: float, models: tuple[SensorModel, ...]) -> DistortionEstimate:
    """Return the scale of the distortion, in figures and words."""
    cumulative = np.cumsum(grid.probability)
    low = float(STRENGTHS[np.searchsorted(cumulative, 0.05)])
    high = float(STRENGTHS[min(int(np.searchsorted(cumulative, 0.95)), len(STRENGTHS) - 1)])
    ratio = float(grid.log_evidence.max() - grid.log_evidence[0])
    edge_px = strength * 0.5 * float(np.mean([model.pixels for model in models]))
    size = (
        f"{100.0 * strength:.2g} % of half the field at its edge, {edge_px:.2g} px "
        f"(90 %: {100.0 * low:.2g} to {100.0 * high:.2g} %)"
    )
    if ratio > NO_DISTORTION_LOG_RATIO:
        reason = (
            f"the lenses distort by about {size}; the readings are e^{ratio:.3g} times as probable "
            "as without distortion"
        )
    elif strength <= STRENGTHS[2]:
        reason = f"the readings show no distortion; what there may be is {size}"
    else:
        reason = (
            f"the readings do not tell whether the lenses distort; {size} may be there, and the "
            "covariance allows for it; more control points near the field's edges would tell"
        )
    return DistortionEstimate("auto", reason, strength, (low, high), edge_px, ratio)

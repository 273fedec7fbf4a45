"""Evaluation of label-error hypotheses of one sensor with the full camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.hypothesis import (
    GROSS_ERROR_PROBABILITY,
    NORMAL_TAIL,
    TYPICAL_OUTLIER_SIGMA,
    Evidence,
    Hypothesis,
    NoiseTail,
    ScalePrior,
)
from compute.calibration.single_sensor.projective_camera import ProjectiveCamera
from compute.calibration.single_sensor.trimmed_least_squares import robust_starts
from compute.camera.model import SensorGeometry

Array = NDArray[np.float64]

ROBUST_STARTS: Final = 3
FIT_STEPS: Final = 40


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """One sensor's readings of the control points.

    Args:
        points_mm: all control points, shape (N, 3) [mm].
        readings_px: shape (N,) [px]; NaN where not seen.
        sigma_px: standard deviations, shape (N,) [px]; any value where not seen.
        sensor: the sensor.
        scale: prior of a common factor of the standard deviations.
        tail: tail of the noise.
        extra: linear distortion columns, see ``ProjectiveCamera``.
        offset_px: fixed offsets of the readings, see ``ProjectiveCamera``.
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array
    sensor: SensorGeometry
    scale: ScalePrior
    tail: NoiseTail = NORMAL_TAIL
    extra: Array | None = None
    offset_px: Array | None = None

    @cached_property
    def observed_mask(self) -> NDArray[np.intp]:
        """Points with a reading."""
        return np.flatnonzero(np.isfinite(self.readings_px))

    @cached_property
    def camera(self) -> ProjectiveCamera:
        """The projective camera over these points."""
        plain = ProjectiveCamera.of(self.points_mm, self.readings_px)
        return replace(plain, extra=self.extra, offset_px=self.offset_px)

    @cached_property
    def robust(self) -> Array:
        """Cameras of least trimmed squares, see ``robust_starts``."""
        return robust_starts(self.camera, self.readings_px, self.sigma_px, ROBUST_STARTS)

    @cached_property
    def evidence(self) -> Evidence:
        """Marginal likelihood of hypotheses."""
        sigma = (
            np.sqrt((self.sigma_px[self.observed_mask] ** 2).mean(keepdims=True))
            * self.scale.factor
        )
        typical = np.array([TYPICAL_OUTLIER_SIGMA])
        density, _ = self.tail.log_density(typical, np.zeros(1), sigma, self.sensor.pixels)
        return Evidence(float(density[0]), self.scale, self.camera.width)

    def exchanged(self, first: int, second: int) -> "SensorReadings":
        """Return the readings with those of two points exchanged.

        Args:
            first: index of a point.
            second: index of another.
        """
        readings, sigma = self.readings_px.copy(), self.sigma_px.copy()
        readings[[first, second]] = readings[[second, first]]
        sigma[[first, second]] = sigma[[second, first]]
        return replace(self, readings_px=readings, sigma_px=sigma)


@dataclass(frozen=True, eq=False)
class EvaluatedHypothesis:
    """A hypothesis with its log posterior (up to a constant of the sensor) and camera."""

    hypothesis: Hypothesis
    log_posterior: float
    theta: Array
    chi2: float
    count: int


def evaluate(
    data: SensorReadings, hypotheses: Sequence[Hypothesis], theta: Array
) -> list[EvaluatedHypothesis]:
    """Fit the camera under each hypothesis and return their log posteriors.

    Args:
        data: the sensor's readings.
        hypotheses: the hypotheses.
        theta: the starting camera, shape (width,).

    Returns:
        The hypotheses that determine the camera.
    """
    if not hypotheses:
        return []
    repaired = [h.repair(data.readings_px, data.sigma_px) for h in hypotheses]
    readings = np.array([one for one, _ in repaired])
    used = np.isfinite(readings)
    sigma = np.where(used, np.array([one for _, one in repaired]), 1.0)
    weights = np.where(used, 1.0 / sigma, 0.0)
    readings = np.where(used, readings, data.camera.centre_px)
    starts = np.broadcast_to(theta, (len(hypotheses), data.camera.width))
    theta_fitted = data.camera.fit(readings, weights, starts, FIT_STEPS)
    fitted, jacobian = data.camera.linearise(theta_fitted)
    chi2 = (((fitted - readings) * weights) ** 2).sum(axis=1)
    weighted = jacobian * weights[..., None]
    normal = weighted.swapaxes(1, 2) @ weighted
    sign, log_determinant = np.linalg.slogdet(normal)
    count = used.sum(axis=1)
    log_outliers = np.zeros(len(hypotheses))
    for row in np.flatnonzero([bool(h.outliers) for h in hypotheses] & (sign > 0.0)).tolist():
        outliers = sorted(hypotheses[row].outliers)
        factor = data.evidence.factor(float(chi2[row]), int(count[row]))
        error, variance = _predict(data, outliers, fitted[row], jacobian[row], normal[row])
        density, _ = data.tail.log_density(
            error / factor, np.sqrt(variance), factor * data.sigma_px[outliers], data.sensor.pixels
        )
        log_outliers[row] = density.sum()
    unseen = len(data.readings_px) - len(data.observed_mask)
    log_posterior = data.evidence.log_likelihood(
        chi2,
        count,
        log_determinant,
        np.log(sigma).sum(axis=1),
        log_outliers,
    ) + np.array([h.log_prior(len(data.observed_mask), unseen) for h in hypotheses])
    return [
        EvaluatedHypothesis(
            hypothesis,
            float(log_posterior[row]),
            theta_fitted[row],
            float(chi2[row]),
            int(count[row]),
        )
        for row, hypothesis in enumerate(hypotheses)
        if sign[row] > 0.0 and count[row] > data.camera.width
    ]


def _predict(
    data: SensorReadings, rows: Sequence[int], fitted: Array, jacobian: Array, normal: Array
) -> tuple[Array, Array]:
    """Return readings minus fitted ones over sigma, and the fit's variance in sigma^2, (K,)."""
    sigma = data.sigma_px[rows]
    gradient = jacobian[rows] / sigma[:, None]
    variance = (gradient * np.linalg.solve(normal, gradient.T).T).sum(axis=1)
    return (data.readings_px[rows] - fitted[rows]) / sigma, np.maximum(variance, 0.0)


@dataclass(frozen=True, eq=False)
class ReadingErrors:
    """Errors of a sensor's readings at their points, as the other readings predict these.

    Args:
        points: points with a reading, counted from 0.
        normalised: errors over sigma; those of kept readings over the residual's own, (n,).
        gross_density: density of a gross error times its probability, per sigma, shape (n,).
        large: of outliers, the probability of an error of ``OUTLIER_SIGMA`` or more; else 0, (n,).
    """

    points: tuple[int, ...]
    normalised: Array
    gross_density: Array
    large: Array


def reading_errors(data: SensorReadings, best: EvaluatedHypothesis) -> ReadingErrors:
    """Return the errors of the readings that a hypothesis leaves with their own labels.

    Args:
        data: the sensor's readings.
        best: the hypothesis.
    """
    hypothesis = best.hypothesis
    moved = set[int]().union(*hypothesis.cycles, *hypothesis.reassigned)
    rows = [point for point in data.observed_mask.tolist() if point not in moved]
    fitted, jacobian = data.camera.linearise(best.theta[None])
    repaired, sigma_px = hypothesis.repair(data.readings_px, data.sigma_px)
    used = np.isfinite(repaired)
    weighted = jacobian[0, used] / sigma_px[used, None]
    factor = data.evidence.factor(best.chi2, best.count)
    error, variance = _predict(data, rows, fitted[0], jacobian[0], weighted.T @ weighted)
    is_outlier = np.array([point in hypothesis.outliers for point in rows], dtype=bool)
    normalised = (
        error / factor / np.sqrt(np.where(is_outlier, 1.0, np.maximum(1.0 - variance, 1e-3)))
    )
    sigma = factor * data.sigma_px[rows]
    _, large = data.tail.log_density(error / factor, np.sqrt(variance), sigma, data.sensor.pixels)
    gross = GROSS_ERROR_PROBABILITY / data.sensor.pixels * sigma
    return ReadingErrors(tuple(rows), normalised, gross, np.where(is_outlier, large, 0.0))

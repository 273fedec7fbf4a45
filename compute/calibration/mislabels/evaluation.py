"""Evaluation of label-error hypotheses of one sensor with the full camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.hypothesis import Evidence, Hypothesis, ScalePrior
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
        extra: linear distortion columns, see ``ProjectiveCamera``.
        offset_px: fixed offsets of the readings, see ``ProjectiveCamera``.
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array
    sensor: SensorGeometry
    scale: ScalePrior
    extra: Array | None = None
    offset_px: Array | None = None

    @cached_property
    def seen(self) -> NDArray[np.intp]:
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
        return Evidence(self.sensor.pixels, self.scale, self.camera.width)

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
    kept: int


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
    kept = np.isfinite(readings)
    sigma = np.where(kept, np.array([one for _, one in repaired]), 1.0)
    weights = np.where(kept, 1.0 / sigma, 0.0)
    readings = np.where(kept, readings, data.camera.centre_px)
    starts = np.broadcast_to(theta, (len(hypotheses), data.camera.width))
    found = data.camera.fit(readings, weights, starts, FIT_STEPS)
    fitted, jacobian = data.camera.linearise(found)
    chi2 = (((fitted - readings) * weights) ** 2).sum(axis=1)
    weighted = jacobian * weights[..., None]
    sign, log_determinant = np.linalg.slogdet(weighted.swapaxes(1, 2) @ weighted)
    count = kept.sum(axis=1)
    unseen = len(data.readings_px) - len(data.seen)
    log_posterior = data.evidence.log_likelihood(
        chi2,
        count,
        log_determinant,
        np.log(sigma).sum(axis=1),
        np.array([len(h.wrong) for h in hypotheses]),
    ) + np.array([h.log_prior(len(data.seen), unseen) for h in hypotheses])
    return [
        EvaluatedHypothesis(
            hypothesis, float(log_posterior[row]), found[row], float(chi2[row]), int(count[row])
        )
        for row, hypothesis in enumerate(hypotheses)
        if sign[row] > 0.0 and count[row] > data.camera.width
    ]

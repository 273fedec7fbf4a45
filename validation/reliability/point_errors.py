"""One wrong reading of a point: how often it is detected and identified, and what theory says."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from compute.camera.stack import CameraStack
from compute.reconstruction.outlier_exclusion import (
    IDENTIFICATION_MARGIN,
    exclude_outliers,
)
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.triangulation import INCONSISTENCY_SIGNIFICANCE, reconstruct
from compute.reliability import ACCEPTANCE_SIGNIFICANCE
from validation.reliability.ring import jacobian, project, ring

Array = NDArray[np.float64]

SIGMA_PX = 0.1
EXTENT_MM = 250.0


@dataclass(frozen=True)
class PointOutcome:
    """Shares of points, measured and by theory, and errors.

    Args:
        detected: with ``inconsistent`` before anything was left out.
        detected_theory: by the non-central chi-square distribution.
        identified: whose wrong reading alone was left out.
        identified_theory: by the normal distribution of the normalised residuals.
        wrongly_excluded: of which a good reading was left out.
        wrongly_excluded_theory: likewise by theory.
        nees: mean normalised error squared of the points that carry no flag.
        before_mm: largest error with all readings.
        after_mm: largest error of the points that are not ``inconsistent`` afterwards.
    """

    detected: float
    detected_theory: float
    identified: float
    identified_theory: float
    wrongly_excluded: float
    wrongly_excluded_theory: float
    nees: float
    before_mm: float
    after_mm: float


def run(sensors: int, size: float, trials: int, rng: np.random.Generator) -> PointOutcome:
    """Reconstruct points of which one reading is wrong.

    Args:
        sensors: number of sensors.
        size: of the error, in standard deviations of the reading.
        trials: number of points.
        rng: of places, noise, wrong sensors and signs.
    """
    matrices, models = ring(sensors)
    cameras = CameraStack.of(models)
    positions = EXTENT_MM * rng.uniform(-1.0, 1.0, (trials, 3))
    noise = rng.standard_normal((trials, sensors))
    wrong = rng.integers(sensors, size=trials)
    row = np.arange(trials)
    noise[row, wrong] += size * rng.choice([-1.0, 1.0], trials)
    readings = project(matrices, positions) + SIGMA_PX * noise
    sigma = np.full(readings.shape, SIGMA_PX)

    def solve(readings_px: Array, sigma_px: Array) -> PointBatch:
        return reconstruct(cameras, readings_px, sigma_px)

    whole = solve(readings, sigma)
    found = exclude_outliers(solve, whole, readings, sigma)
    excluded = (whole.used & ~found.used).astype(np.intp)
    right = (excluded.sum(axis=1) == 1) & (excluded[row, wrong] == 1)
    inconsistent = (found.flags & int(PointFlag.INCONSISTENT)) != 0
    error = found.position_mm - positions
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_mm2), error)
    theory = _theory(jacobian(matrices, positions) / SIGMA_PX, wrong, size, rng)
    length = np.linalg.norm(error, axis=1)
    return PointOutcome(
        float(((whole.flags & int(PointFlag.INCONSISTENT)) != 0).mean()),
        theory[0],
        float(right.mean()),
        theory[1],
        float((excluded.any(axis=1) & ~right).mean()),
        theory[2],
        float(squares[~inconsistent].mean()) if not inconsistent.all() else np.nan,
        float(np.linalg.norm(whole.position_mm - positions, axis=1).max()),
        float(length[~inconsistent].max(initial=0.0)),
    )


def _theory(
    design: Array, wrong: NDArray[np.intp], size: float, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return the shares detected, identified, and wrongly excluded, of linear equations.

    The normalised residuals are normal: their means are the error's, their correlations those of
    the projector on the redundant part of the readings.

    Args:
        design: Jacobian in standard deviations, shape (N, S, 3).
        wrong: which reading is wrong, shape (N,).
        size: of the error in standard deviations.
        rng: of the normal residuals.
    """
    trials, sensors = design.shape[:2]
    basis = np.linalg.qr(design)[0]
    projector = np.eye(sensors) - basis @ basis.swapaxes(1, 2)
    redundancy = np.diagonal(projector, axis1=1, axis2=2)
    row, dof = np.arange(trials), sensors - 3
    limit = stats.chi2.isf(INCONSISTENCY_SIGNIFICANCE, dof)
    detected = float(np.mean(stats.ncx2.sf(limit, dof, size**2 * redundancy[row, wrong])))
    if size == 0.0:
        detected = INCONSISTENCY_SIGNIFICANCE
    errors = rng.standard_normal((trials, sensors))
    errors[row, wrong] += size
    residual = np.einsum("nij,nj->ni", projector, errors)
    chi2 = (residual**2).sum(axis=1)
    if dof < 2:
        return detected, 0.0, 0.0
    lowered = residual**2 / redundancy
    best = lowered.argmax(axis=1)
    second, first = np.partition(lowered, -2, axis=1)[:, -2:].T
    accepted = (
        (chi2 > limit)
        & (first - second >= IDENTIFICATION_MARGIN)
        & (first >= stats.chi2.isf(INCONSISTENCY_SIGNIFICANCE / sensors, 1))
        & (chi2 - first <= stats.chi2.isf(ACCEPTANCE_SIGNIFICANCE, dof - 1))
    )
    right = accepted & (best == wrong)
    return detected, float(right.mean()), float((accepted & (best != wrong)).mean())

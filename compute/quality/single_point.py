"""Single-point test: repeated measurements of a stationary marker."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.quality.statistics import ErrorStatistics, error_statistics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SinglePoint:
    """Precision of a stationary marker.

    Args:
        position_mm: mean position [mm].
        scatter: distances from the mean [mm].
        axes_mm: standard deviation along X, Y and Z [mm].
        stated_mm: root of the mean squared distance expected from the points' own covariances, an
            upper limit as these include errors common to all points [mm].
        drift_mm_per_min: speed of the straight line through the positions [mm/min].
        drift_sigma_mm_per_min: its standard deviation, from the scatter.
        bias: the mean's distance from the reference [mm]; None without one.
    """

    position_mm: Vector3
    scatter: ErrorStatistics
    axes_mm: Vector3
    stated_mm: float
    drift_mm_per_min: float
    drift_sigma_mm_per_min: float
    bias: float | None


def single_point(
    position_mm: Array,
    covariance_mm2: Array,
    time_s: Array,
    reference_mm: Array | None = None,
) -> SinglePoint:
    """Measure the precision of a stationary marker; the single-point test of ASTM F2554.

    The covariances include the calibration's, whose error is the same in each point and does not
    appear in the scatter: ``stated_mm`` is an upper limit of the scatter.

    Args:
        position_mm: N positions of the marker, shape (N, 3) [mm].
        covariance_mm2: theirs, shape (N, 3, 3) [mm^2].
        time_s: when each was measured, shape (N,) [s].
        reference_mm: where it is, shape (3,) [mm]; None: not known.

    Raises:
        TooFewPoints: fewer than two points.
        InvalidParameter: a value is not finite.
    """
    if not (np.isfinite(position_mm).all() and np.isfinite(covariance_mm2).all()):
        raise InvalidParameter("a position or covariance is not a number; leave such points out")
    mean = position_mm.mean(axis=0) if len(position_mm) else np.zeros(3)
    deviations = position_mm - mean
    scatter = error_statistics(np.linalg.norm(deviations, axis=1))
    speed, sigma = _drift(deviations, time_s)
    variances = np.einsum("nii->n", covariance_mm2)
    axes = deviations.std(axis=0, ddof=1)
    return SinglePoint(
        (float(mean[0]), float(mean[1]), float(mean[2])),
        scatter,
        (float(axes[0]), float(axes[1]), float(axes[2])),
        float(np.sqrt(variances.mean())),
        60.0 * speed,
        60.0 * sigma,
        None if reference_mm is None else float(np.linalg.norm(mean - reference_mm)),
    )


def _drift(deviations: Array, time_s: Array) -> tuple[float, float]:
    """Return the speed of the linear fit to the points and its standard deviation [mm/s]."""
    since = time_s - time_s.mean()
    lever = float((since**2).sum())
    if lever == 0.0 or len(deviations) < 3:
        return 0.0, np.inf
    velocity = since @ deviations / lever
    left = deviations - since[:, None] * velocity
    variance = (left**2).sum() / (len(deviations) - 2) / lever
    return float(np.linalg.norm(velocity)), float(np.sqrt(variance))

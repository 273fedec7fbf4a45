"""Triangulation in NumPy: linear, then weighted non-linear with covariance."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reliability import ReadingChecks, check_readings, noncentrality

Array = NDArray[np.float64]

CONDITION_LIMIT = 1e-10
"""Smallest ratio of singular values at which three planes still count as meeting in a point."""
MAX_ITERATIONS = 30
WEIGHTING_ITERATIONS = 2
"""Iterations after the linear solution before the weights are computed at the point."""
INITIAL_DAMPING = 1e-6
MAX_DAMPING = 1e12
STEP_TOLERANCE_MM = 1e-6
CHI2_ROUNDING_FACTOR = 1.0 + 1e-10
"""Steps near the end change chi2 by less than its rounding: growth up to this factor is none."""
_DIAGONAL = np.arange(3)
INCONSISTENCY_SIGNIFICANCE = 1e-4
"""Probability that a consistent point is flagged as inconsistent."""
INTERSECTION_CHI2_TOLERANCE = 1e-6
"""Largest chi2 of an intersection of three planes: far above rounding, far below noise."""
UNINFORMATIVE_SIGMA_RATIO = 1e3
"""A reading this many times less certain than the third best is not used."""
DEGENERATE_RATIO = 1e-14
"""Smallest ratio of eigenvalues of the normal matrix; its root is the planes' conditioning."""


def reconstruct(
    models: Sequence[SensorModel] | CameraStack,
    readings_px: Array,
    sigma_px: Array,
    parameter_covariance: Array | None = None,
    corrections: CorrectionTable | None = None,
    *,
    reliability: bool = True,
) -> PointBatch:
    """Reconstruct points from the readings of any three or more sensors.

    Minimises r' S^-1 r by Levenberg-Marquardt, from the linear solution, for all points at once:
    r are readings, corrected as of the point, less projections; S is their covariance: the
    readings' noise plus what the cameras' own covariance does to the projections at that place,
    plus the table's variance there. Where the iteration ends, a reading is corrected by the voxel
    of the very point that it gives: the fixed point of reading, correcting and solving in turn.

    Distortion and corrections of ten pixels move the linear solution by centimetres; S is that of
    the place two steps on, which is hundredths of a millimetre off.

    Args:
        models: S calibrated cameras (or their stack, when it is used again and again).
        readings_px: shape (N, S) [px]; NaN where a sensor did not see the point.
        sigma_px: standard deviations of the readings, shape (N, S) or (S,) [px], positive.
        parameter_covariance: joint covariance of the cameras' parameters, shape (P, P), sensor by
            sensor in the order of ``SensorModel.parameter_names``. None: taken as exact.
        corrections: of the S sensors' readings, over space. None: none.
        reliability: whether to work out the external reliability; it is NaN otherwise.

    Returns:
        The points; those that cannot be had carry NaN and a flag that says why.

    Raises:
        InvalidParameter: the table is of another number of sensors.
    """
    model = MeasurementModel.of(models, parameter_covariance, corrections)
    cameras = model.cameras
    readings = np.asarray(readings_px, dtype=np.float64)
    readings = np.where(np.isfinite(readings), readings, np.nan)
    sigma = sigma_px * np.abs(cameras.correction_derivative(readings))
    target = cameras.add_cubic_term(readings)
    used = _select_informative(np.isfinite(target) & np.isfinite(sigma) & (sigma > 0.0), sigma)
    count = used.sum(axis=1)

    target = np.where(used, target, np.nan)
    start = triangulate_linear(cameras, target)
    sigma = np.where(used, sigma, 1.0)
    equations = _Equations(model, np.where(used, readings, np.nan))
    linearisation_mm = start
    if cameras.has_distortion or corrections is not None:
        linearisation_mm = _refine(
            equations, np.eye(len(cameras)) / sigma[:, :, None], start, WEIGHTING_ITERATIONS
        )[0]
    variance = reading_variance(model, readings, sigma_px, used, linearisation_mm)
    whitening = model.whitening(linearisation_mm, variance, used)
    position, gram, converged = _refine(equations, whitening, linearisation_mm)
    normal, chi2 = gram[:, :3, :3], gram[:, 3, 3]
    # Three readings have a point that fits exactly, unless a table bends them past one another:
    # then the search rests where they come nearest, and that is no point.
    converged &= (count > 3) | (chi2 <= INTERSECTION_CHI2_TOLERANCE)

    flags = np.zeros(len(readings), dtype=np.int32)
    flags[count < 3] = PointFlag.TOO_FEW_SENSORS
    flags[(count >= 3) & ~np.isfinite(start[:, 0])] = PointFlag.DEGENERATE
    flags[np.isfinite(start[:, 0]) & ~converged] = PointFlag.NO_CONVERGENCE
    normal[flags != 0] = np.eye(3)
    spectrum = np.linalg.eigvalsh(normal)
    flags[spectrum[:, 0] <= DEGENERATE_RATIO * spectrum[:, 2]] = PointFlag.DEGENERATE
    missing = flags != 0
    normal[missing] = np.eye(3)
    covariance: Array = np.asarray(np.linalg.inv(normal), dtype=np.float64)

    limits = chi2_limits(len(cameras))
    shift = np.full(len(readings), np.nan)
    if reliability:
        located = ~missing
        checks = equations.checks(position[located], located, whitening[located])
        shift[located] = external_reliability(checks, used[located])
    flags[~missing & (count == 3)] |= PointFlag.NO_REDUNDANCY
    flags[~missing & (chi2 > limits[count])] |= PointFlag.INCONSISTENT
    if corrections is not None:
        foreign = (used & ~model.inside_hull(position)).any(axis=1)
        flags[~missing & foreign] |= PointFlag.OUTSIDE_MAP
        flags[~missing & ~model.in_box(position)] |= PointFlag.NO_COVARIANCE
    position[missing], covariance[missing], chi2[missing] = np.nan, np.nan, np.nan
    return PointBatch(position, covariance, chi2, shift, used, flags)


def reading_variance(
    model: MeasurementModel,
    readings_px: Array,
    sigma_px: Array,
    used: NDArray[np.bool_],
    position_mm: Array,
) -> Array:
    """Return the variances of corrected readings, the table's included, shape (N, S) [px^2].

    Args:
        model: the cameras and their correction table.
        readings_px: shape (N, S) [px].
        sigma_px: standard deviations of the readings, shape (N, S) or (S,) [px].
        used: which readings count; the variance of others is 1, shape (N, S).
        position_mm: the points, shape (N, 3) [mm].
    """
    derivative = model.cameras.correction_derivative(readings_px)
    variance = np.where(used, (sigma_px * np.abs(derivative)) ** 2, 1.0)
    if model.corrections is not None:
        table_variance = np.nan_to_num(model.corrections.at(position_mm).variance_px2)
        variance += np.where(used, table_variance * derivative**2, 0.0)
    return variance


def _select_informative(usable: NDArray[np.bool_], sigma: Array) -> NDArray[np.bool_]:
    """Leave out readings that say next to nothing beside the three best, shape (N, S).

    They would count as redundancy and have none.
    """
    if usable.shape[1] < 4:
        return usable
    third = np.partition(np.where(usable, sigma, np.inf), 2, axis=1)[:, 2:3]
    return usable & (sigma <= UNINFORMATIVE_SIGMA_RATIO * third)


@dataclass(frozen=True, eq=False)
class _Equations:
    """The readings (N, S), NaN where not used, as equations for their points."""

    model: MeasurementModel
    readings_px: Array

    def checks(
        self, position: Array, index: NDArray[np.bool_] | slice, whitening: Array
    ) -> ReadingChecks:
        """Test the readings of points against one another.

        Args:
            position: of the points ``index``, shape (N, 3).
            index: which of the points.
            whitening: of these points, shape (N, S, S).
        """
        return check_readings(*self._rows(position, index), whitening)

    def _rows(
        self, position: Array, index: NDArray[np.intp] | NDArray[np.bool_] | slice
    ) -> tuple[Array, Array]:
        """Return Jacobians (N, S, 3) and residuals (N, S), zeros for readings not used."""
        readings = self.readings_px[index]
        residual, jacobian = self.model.residuals(readings, position)
        unused = np.isnan(readings)
        residual[unused], jacobian[unused] = 0.0, 0.0
        return jacobian, residual

    def gram(self, position: Array, index: NDArray[np.intp] | slice, whitening: Array) -> Array:
        """Return A' A of A, whitened Jacobians and residuals side by side, shape (N, 4, 4).

        Args:
            position: of the points ``index``, shape (N, 3).
            index: which of the points.
            whitening: of these points, shape (N, S, S).
        """
        jacobian, residual = self._rows(position, index)
        whitened = whitening @ np.concatenate([jacobian, residual[..., None]], axis=-1)
        gram: Array = whitened.transpose(0, 2, 1) @ whitened
        return gram


def _solve(gram: Array, damping: Array) -> Array:
    """Return the damped steps of equations, shape (N, 3)."""
    normal = gram[:, :3, :3].copy()
    diagonal = normal[:, _DIAGONAL, _DIAGONAL]
    floor = 1e-300 + 1e-15 * diagonal.max(axis=1, keepdims=True)
    normal[:, _DIAGONAL, _DIAGONAL] += damping[:, None] * diagonal + floor
    return np.asarray(np.linalg.solve(normal, gram[:, :3, 3:])[..., 0], dtype=np.float64)


def _refine(
    equations: _Equations, whitening: Array, start: Array, max_iterations: int = MAX_ITERATIONS
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Levenberg-Marquardt for all points, up to ``max_iterations``.

    Returns:
        Positions (N, 3), A' A of the whitened equations there (N, 4, 4), which converged (N,).
    """
    position = start.copy()
    gram = equations.gram(position, slice(None), whitening)
    damping = np.full(len(start), INITIAL_DAMPING)
    converged = np.zeros(len(start), dtype=np.bool_)
    # A start behind a lens has no residual; the point stays unconverged and is flagged.
    index = np.flatnonzero(np.isfinite(gram[:, 3, 3]))
    for _ in range(max_iterations):
        if len(index) == 0:
            break
        step = _solve(gram[index], damping[index])
        trial = position[index] + step
        trial_gram = equations.gram(trial, index, whitening[index])
        # The next step would be shorter by the curvature over this one's length: below a
        # nanometre, far under any rounding of the result, it is not worth taking.
        small = np.abs(step).max(axis=1) <= STEP_TOLERANCE_MM
        better = trial_gram[:, 3, 3] <= CHI2_ROUNDING_FACTOR * gram[index, 3, 3]
        better |= small & np.isfinite(trial_gram[:, 3, 3])
        accepted = index[better]
        position[accepted] = trial[better]
        gram[accepted] = trial_gram[better]
        damping[index] *= np.where(better, 0.1, 10.0)
        converged[index] = small
        index = index[~small & (damping[index] < MAX_DAMPING)]
    return position, gram, converged


@cache
def chi2_limit(dof: int, probability: float) -> float:
    """Return the chi2 that noise exceeds with a given probability.

    Args:
        dof: degrees of freedom; below 1 the limit is infinite.
        probability: between 0 and 1.
    """
    return float(chdtri(dof, probability)) if dof > 0 else float("inf")


def chi2_limits(sensors: int) -> Array:
    """Return the largest chi2 of a consistent point of 0, 1, ... S sensors, shape (S + 1,)."""
    return np.array([chi2_limit(n - 3, INCONSISTENCY_SIGNIFICANCE) for n in range(sensors + 1)])


def noncentralities(sensors: int) -> Array:
    """Return Baarda's lambda_0 of the chi-square test of 0, 1, ... S sensors, shape (S + 1,)."""
    return np.array([noncentrality(n - 3, INCONSISTENCY_SIGNIFICANCE) for n in range(sensors + 1)])


def external_reliability(checks: ReadingChecks, used: NDArray[np.bool_]) -> Array:
    """Return the largest shift of each point by a minimal detectable error, shape (N,) [mm].

    Baarda's external reliability (1968); infinite where nothing checks some used reading.

    Args:
        checks: of the readings of N points.
        used: which readings count, shape (N, S).
    """
    size = _detectable_px(checks, used)
    shift = np.linalg.norm(checks.influence, axis=1) * np.where(used, size, 0.0)
    largest: Array = shift.max(axis=1, initial=0.0)
    return largest


def detectable_errors(
    model: MeasurementModel, points: PointBatch, readings_px: Array, sigma_px: Array
) -> Array:
    """Return the minimal detectable bias of each reading of N points, shape (N, S) [px].

    W. Baarda's internal reliability (1968): the error that the chi-square test finds with a
    probability of 0.8; infinite where the other readings do not check it, NaN where it is not used
    or the point has no covariance.

    Args:
        model: the cameras, their covariance and the correction table.
        points: N points of these readings.
        readings_px: shape (N, S) [px].
        sigma_px: their standard deviations, shape (N, S) or (S,) [px].
    """
    detectable = np.full(points.used.shape, np.nan)
    finite = np.isfinite(points.position_mm[:, 0])
    finite &= (points.flags & int(PointFlag.NO_COVARIANCE)) == 0
    if not finite.any():
        return detectable
    position, used = points.position_mm[finite], points.used[finite]
    readings = np.where(used, np.asarray(readings_px)[finite], np.nan)
    sigma = np.broadcast_to(sigma_px, points.used.shape)[finite]
    whitening = model.whitening(
        position, reading_variance(model, readings, sigma, used, position), used
    )
    checks = _Equations(model, readings).checks(position, slice(None), whitening)
    # A raw reading is stretched by the cubic distortion.
    size = _detectable_px(checks, used) / np.abs(model.cameras.correction_derivative(readings))
    detectable[finite] = np.where(used, size, np.nan)
    return detectable


def _detectable_px(checks: ReadingChecks, used: NDArray[np.bool_]) -> Array:
    """Return the minimal detectable errors of corrected readings, shape (N, S) [px]."""
    return checks.detectable_px(noncentralities(used.shape[1])[used.sum(axis=1)][:, None])


def squared_distances(difference: Array, covariance: Array) -> Array:
    """Return squared Mahalanobis distances, shape (...).

    Args:
        difference: of D coordinates, shape (..., D).
        covariance: of the differences, shape (..., D, D).
    """
    solved = np.linalg.solve(covariance, difference[..., None])[..., 0]
    squared: Array = (difference * solved).sum(axis=-1)
    return squared


def triangulate_linear(cameras: CameraStack, corrected_px: Array) -> Array:
    """Intersect the planes of corrected readings; thesis [5.13]-[5.15], [5.22]-[5.24].

    Each reading q gives one plane ``(m1 - q m2).X~ = 0``. With the metric matrices this is
    [5.22]; the thesis's DLT form [5.13] differs by a factor for each sensor.

    Args:
        cameras: S cameras.
        corrected_px: readings with the cubic term, shape (N, S); NaN where not seen.

    Returns:
        Points, shape (N, 3) [mm]; NaN where fewer than three sensors saw the point or where
        the planes meet in a line.
    """
    matrices = cameras.matrices
    usable = np.isfinite(corrected_px)
    q = np.where(usable, corrected_px, 0.0)
    rows = matrices[:, 0] - q[..., None] * matrices[:, 1]
    rows = rows * usable[..., None]
    points = np.full((len(rows), 3), np.nan)
    enough = usable.sum(axis=1) >= 3
    if not enough.any():
        return points
    # QR instead of the normal equations (A'A)^-1 of [5.15]: the same solution, without squaring
    # the condition number.
    q_factor, r_factor = np.linalg.qr(rows[enough, :, :3])
    singular = np.linalg.svd(r_factor, compute_uv=False)
    good = singular[:, 2] > CONDITION_LIMIT * singular[:, 0]
    right = -np.einsum("nsi,ns->ni", q_factor, rows[enough, :, 3])
    solved = np.full((len(right), 3), np.nan)
    solved[good] = np.linalg.solve(r_factor[good], right[good, :, None])[..., 0]
    points[enough] = solved
    return points

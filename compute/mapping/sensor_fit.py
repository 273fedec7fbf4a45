"""The penalised fit of one sensor's corrections, with the calibration's own error in it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from compute.errors import DegeneratePoints, TooFewPoints
from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.model_averaging import AveragedFit, average
from compute.mapping.p_splines import GROSS_ERROR_THRESHOLD, PenalisedFit, PenalisedProblem
from compute.mapping.penalty_selection import (
    FittedPenalty,
    PenaltyPosterior,
    cross_validate_penalties,
    fit_penalty,
    gcv_score,
    single_penalty,
)
from compute.mapping.result import SensorMapping, Suspect
from compute.mapping.sensor_data import (
    CHUNK,
    SensorData,
    accumulate_equations,
    left_out_blocks,
    stack_functions,
)
from compute.mapping.spline_interpolation import interpolate_function

Array = NDArray[np.float64]

UNINFORMATIVE_PRECISION = 1e-6
"""Of calibration errors that the measurements themselves must tell, in units of what they do."""
MIN_SINGULAR_RATIO = 1e-9
"""Ratio of singular values below which the measurements leave the calibration open."""
UNEXPLAINED_PROBABILITY = 0.01
"""Chance that right deviations are taken for too small."""
CONTRADICTED_PROBABILITY = 1e-4
"""Of the same by what left-out blocks say, which a field that is rough in places can say, too;
deviations that are half of the right ones go far beyond."""
MAX_ITERATIONS = 8
"""Of fitting and of taking the samples' variances anew."""
FACTOR_TOLERANCE = 0.05
VARIANCE_FLOOR_PX2 = 1e-12
"""Exact measurements still leave rounding."""


@dataclass(frozen=True, eq=False)
class FittedCorrection:
    """A sensor's correction: splines and the calibration's error.

    Args:
        functions: the penalised functions.
        parameter_transform: makes of the camera's parameters the functions fitted beside, shape (P, Q).
        parameter_jacobian: as in SensorData.
        chosen: the likeliest penalty and the fit with it.
        average: over the penalties.
        variance_factor: by what the samples' variances were multiplied before the fit.
    """

    functions: DiagonalisedBasis
    parameter_transform: Array
    parameter_jacobian: Callable[[Array], Array]
    chosen: FittedPenalty
    average: AveragedFit
    variance_factor: float

    @property
    def factor(self) -> float:
        """By what the samples' variances are to be multiplied, as the fit shows."""
        return self.variance_factor * self.average.factor

    @property
    def coefficients_px(self) -> Array:
        """Cubic coefficients of the whole correction, shape (nx + 3, ny + 3, nz + 3) [px]."""
        amounts = self.average.amounts
        count = len(self.functions)
        camera_functions = self.parameter_transform @ amounts[count:]
        return self.functions.coefficients(amounts[:count]) + interpolate_function(
            self.functions.grid, lambda points: self.parameter_jacobian(points) @ camera_functions
        )

    def variance_px2(self, points_mm: Array) -> Array:
        """Return the variances of the expected readings at points (N, 3), shape (N,) [px^2]."""
        parts = []
        for start in range(0, len(points_mm), CHUNK):
            points = points_mm[start : start + CHUNK]
            rows = stack_functions(
                self.functions, self.parameter_jacobian(points) @ self.parameter_transform, points
            )
            parts.append(self.average.variance(rows))
        return np.concatenate(parts)


def fit_sensor(
    data: SensorData,
    functions: DiagonalisedBasis,
    penalty_weight: float | None,
    on_trial: Callable[[], None],
) -> FittedCorrection:
    """Fit one sensor's corrections.

    What is corrected is ``J delta + m``: the calibrated camera is off by delta, and a camera of
    its kind is off the real one by a smooth m. Both are fitted at once (kriging with a drift; N.
    A. C. Cressie, Statistics for Spatial Data, 1993, section 3.4), so that the variance of the
    sum is that of the expected reading, and nothing is counted twice.

    Raises:
        TooFewPoints, DegeneratePoints: the measurements cannot tell the calibration's error.
    """
    parameter_transform, precision = _parameter_drift(data)
    contradiction = float(chdtri(1.0, 2.0 * CONTRADICTED_PROBABILITY))  # too small ones alone
    separable = data.parameter_covariance is not None
    variance_factor = (
        _initial_variance(data, parameter_transform)
        if separable and not data.known_variance
        else 1.0
    )
    for _ in range(MAX_ITERATIONS):
        applied_factor = variance_factor
        scaled = replace(data, variance_px2=data.variance_px2 * applied_factor)
        problem = accumulate_equations(scaled, functions, parameter_transform, precision)

        def select_penalty(
            problem: PenalisedProblem, applied_factor: float = applied_factor
        ) -> PenaltyPosterior:
            if penalty_weight is None:
                return cross_validate_penalties(problem, functions, on_trial)
            # Where the variances are not known, the weight is in units of theirs.
            weight = penalty_weight if data.known_variance else penalty_weight / applied_factor
            return single_penalty(problem, functions, weight)

        penalties = select_penalty(problem)
        estimated = not data.known_variance or applied_factor != 1.0
        if problem.known_variance and penalties.contradicts_variances(contradiction):
            estimated = True
            problem = replace(problem, known_variance=False)
            penalties = select_penalty(problem)
        likeliest = penalties.trials[penalties.best]
        chosen = fit_penalty(problem, functions, likeliest.weight, likeliest.axes)
        ratio = _variance_ratio(chosen.fit) if estimated else _excess_variance(chosen.fit)
        variance_factor = max(applied_factor * ratio, VARIANCE_FLOOR_PX2)
        # The samples' variances have a factor, the calibration's own have none: they are weighed
        # anew. Where the measurements alone tell both, the factor is all's.
        if not separable or abs(variance_factor / applied_factor - 1.0) < FACTOR_TOLERANCE:
            break
    each = _variance_ratio if estimated else lambda _fit: ratio
    averaged = average(problem, functions, penalties, each)
    return FittedCorrection(
        functions, parameter_transform, data.parameter_jacobian, chosen, averaged, applied_factor
    )


def _initial_variance(data: SensorData, parameter_transform: Array) -> float:
    """Return what a camera of its kind leaves of the samples at most, by their count [px^2]."""
    parameter_jacobian = data.parameter_jacobian(data.points_mm) @ parameter_transform
    rest = (
        data.samples_px
        - parameter_jacobian @ np.linalg.lstsq(parameter_jacobian, data.samples_px)[0]
    )
    dof = max(len(rest) - parameter_jacobian.shape[1], 1)
    left = float(rest @ rest) / float(dof)
    return left if left > VARIANCE_FLOOR_PX2 else VARIANCE_FLOOR_PX2


def summarise_fit(data: SensorData, fitted: FittedCorrection, valid_share: float) -> SensorMapping:
    """Return the figures of a fit."""
    fit, average = fitted.chosen.fit, fitted.average
    order, _ = left_out_blocks(data.block)
    normalised_error = np.abs(average.error) / average.sigma
    errors = average.error * np.sqrt(data.variance_px2[order] * fitted.variance_factor)
    worst = np.argsort(-normalised_error, kind="stable")[
        : int((normalised_error > GROSS_ERROR_THRESHOLD).sum())
    ]
    suspects = tuple(
        Suspect(int(data.numbers[order[one]]), float(errors[one]), float(normalised_error[one]))
        for one in worst
    )
    factor = fitted.factor
    x, y, z = fitted.chosen.axes.tolist()
    residual = _residuals(data, fitted)
    return SensorMapping(
        data.name,
        len(data.samples_px),
        _rms(data.samples_px),
        _rms(residual),
        _rms(errors),
        float((normalised_error**2).mean()),
        average.effective_parameters,
        float(fitted.chosen.weight * (1.0 if data.known_variance else fitted.variance_factor)),
        (x, y, z),
        float(np.sqrt(gcv_score(fit) / (fit.left_out().error ** 2).mean())),
        float(np.sqrt(data.variance_px2.mean() * (1.0 if data.known_variance else factor))),
        factor if data.known_variance else 1.0,
        valid_share,
        suspects,
    )


def _parameter_drift(data: SensorData) -> tuple[Array, Array]:
    """Return what makes functions of the camera's parameters, and their prior precisions."""
    parameter_jacobian = data.parameter_jacobian(data.points_mm)
    if data.parameter_covariance is not None:
        values, vectors = np.linalg.eigh(data.parameter_covariance)
        parameter_transform = vectors * np.sqrt(np.maximum(values, 0.0))
        return parameter_transform, np.ones(parameter_transform.shape[1])
    count = parameter_jacobian.shape[1]
    if len(parameter_jacobian) <= count:
        raise TooFewPoints(
            f"sensor {data.name} saw {len(parameter_jacobian)} mapping points and its calibration has "
            f"{count} parameters, whose errors they are to tell; give at least {count + 1} "
            "points, or other points than the calibration's together with its covariance",
            sensor=data.name,
            points=len(parameter_jacobian),
        )
    whitened = parameter_jacobian / np.sqrt(data.variance_px2)[:, None]
    scale = np.linalg.norm(whitened, axis=0)
    # What no reading depends on, as the place along the slit where no term has v in it.
    acting = scale > 0.0
    _, singular, right = np.linalg.svd(whitened[:, acting] / scale[acting], full_matrices=False)
    if singular[-1] < MIN_SINGULAR_RATIO * singular[0]:
        raise DegeneratePoints(
            f"the {len(parameter_jacobian)} mapping points that sensor {data.name} saw leave a combination of "
            f"its calibration's parameters open (ratio of singular values "
            f"{singular[-1] / singular[0]:.1e}); add points at other places and depths",
            sensor=data.name,
        )
    parameter_transform = np.zeros((count, len(singular)))
    parameter_transform[acting] = (right.T / singular) / scale[acting, None]
    return parameter_transform, np.full(len(singular), UNINFORMATIVE_PRECISION)


def _residuals(data: SensorData, fitted: FittedCorrection) -> Array:
    """Return what the fit leaves of the samples, shape (N,) [px]."""
    parts = []
    for start in range(0, len(data.points_mm), CHUNK):
        points = data.points_mm[start : start + CHUNK]
        rows = stack_functions(
            fitted.functions, data.parameter_jacobian(points) @ fitted.parameter_transform, points
        )
        parts.append(rows @ fitted.average.amounts)
    rest: Array = data.samples_px - np.concatenate(parts)
    return rest


def _variance_ratio(fit: PenalisedFit) -> float:
    """Return by what the samples' variances are too small, from the residuals."""
    return fit.residual_sum_of_squares / _residual_dof(fit)


def _excess_variance(fit: PenalisedFit) -> float:
    """Return the same of known variances, which hold as long as no residuals contradict them."""
    wrong = fit.residual_sum_of_squares > chdtri(_residual_dof(fit), UNEXPLAINED_PROBABILITY)
    return _variance_ratio(fit) if wrong else 1.0


def _residual_dof(fit: PenalisedFit) -> float:
    return max(fit.problem.count - fit.effective_parameters, 1.0)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))

"""Penalised fit of one sensor's corrections together with the calibration's error."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from compute.camera.observation_checks import UNEXPLAINED_PROBABILITY
from compute.errors import DegeneratePoints, TooFewPoints
from compute.mapping.b_splines import interpolate_function
from compute.mapping.coverage import Coverage
from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import GROSS_ERROR_THRESHOLD, PenalisedFit, PenalisedProblem
from compute.mapping.penalty_grid import PenaltyTrial, evaluate_penalty
from compute.mapping.penalty_selection import (
    AveragedFit,
    PenaltyPosterior,
    average,
    cross_validate_penalties,
    gcv_score,
)
from compute.mapping.result import SensorMapping, Suspect, describe_coverage
from compute.mapping.sensor_data import (
    CorrectionFunctions,
    SensorData,
    accumulate_equations,
    left_out_blocks,
)

Array = NDArray[np.float64]

UNINFORMATIVE_PRECISION = 1e-6
"""Prior precision of calibration errors that the measurements determine, relative to theirs."""
MIN_SINGULAR_RATIO = 1e-9
"""Ratio of singular values below which the measurements leave the calibration open."""
CONTRADICTED_PROBABILITY = 1e-4
"""The same, judged by left-out blocks: smaller, as a locally rough field fails this test, too;
standard deviations that are half of the right ones go far beyond."""
MAX_ITERATIONS = 8
"""Largest number of fits with updated variances of the samples."""
FACTOR_TOLERANCE = 0.05
VARIANCE_FLOOR_PX2 = 1e-12
"""Exact measurements still leave rounding."""


@dataclass(frozen=True, eq=False)
class FittedCorrection:
    """One sensor's correction: splines plus the calibration's error.

    Args:
        model: the functions of which it is composed.
        chosen: the most probable penalty.
        fit: the fit with it.
        average: average over the penalties.
        variance_factor: factor of the samples' variances before the fit.
    """

    model: CorrectionFunctions
    chosen: PenaltyTrial
    fit: PenalisedFit
    average: AveragedFit
    variance_factor: float

    @property
    def factor(self) -> float:
        """Factor of the samples' variances that the fit shows."""
        return self.variance_factor * self.average.factor

    @property
    def coefficients_px(self) -> Array:
        """Cubic coefficients of the whole correction, shape (nx + 3, ny + 3, nz + 3) [px]."""
        amounts, model = self.average.amounts, self.model
        count = len(model.functions)
        parameters = model.parameter_transform @ amounts[count:]
        return model.functions.coefficients(amounts[:count]) + interpolate_function(
            model.functions.grid, lambda points: model.parameter_jacobian(points) @ parameters
        )

    def variance_px2(self, points_mm: Array) -> Array:
        """Return the variances of predicted readings at points (N, 3), shape (N,) [px^2]."""
        return self.model.in_chunks(points_mm, self.average.variance)


def fit_sensor(
    data: SensorData,
    functions: DiagonalisedBasis,
    penalty_weight: float | None,
    on_trial: Callable[[], None],
) -> FittedCorrection:
    """Fit one sensor's corrections.

    The correction is ``J delta + m``: an error delta of the calibration's parameters, and a smooth
    misfit m of the camera model. Both are fitted jointly (kriging with a drift; N. A. C. Cressie,
    Statistics for Spatial Data, 1993, section 3.4), so that the variance of the sum is that of the
    predicted reading, and nothing is counted twice.

    Args:
        data: the samples.
        functions: the penalised functions.
        penalty_weight: weight of the penalty [1/px^2]; None: by cross-validation.
        on_trial: called after each trial of a penalty.

    Raises:
        TooFewPoints, DegeneratePoints: the measurements do not determine the calibration's error.
    """
    model = CorrectionFunctions(functions, data.parameter_jacobian, *_parameter_drift(data))
    contradiction = float(chdtri(1.0, 2.0 * CONTRADICTED_PROBABILITY))  # too small ones alone
    separable = data.parameter_covariance is not None
    variance_factor = 1.0
    if separable and not data.known_variance:
        variance_factor = _initial_variance(data, model.parameter_transform)
    for _ in range(MAX_ITERATIONS):
        applied_factor = variance_factor
        scaled = replace(data, variance_px2=data.variance_px2 * applied_factor)
        problem = accumulate_equations(scaled, model)

        def select_penalty(
            problem: PenalisedProblem, applied_factor: float = applied_factor
        ) -> PenaltyPosterior:
            if penalty_weight is None:
                return cross_validate_penalties(problem, functions, on_trial)
            # Where the variances are not known, the weight is in units of theirs.
            weight = penalty_weight if data.known_variance else penalty_weight / applied_factor
            known = evaluate_penalty(problem, functions, weight, np.ones(3))
            return PenaltyPosterior((known,), 0, np.ones(1))

        penalties = select_penalty(problem)
        estimated = not data.known_variance or applied_factor != 1.0
        if problem.known_variance and penalties.contradicts_variances(contradiction):
            estimated = True
            problem = replace(problem, known_variance=False)
            penalties = select_penalty(problem)
        chosen = penalties.trials[penalties.best]
        fit = chosen.fit(problem, functions)
        ratio = _variance_ratio(fit) if estimated else _excess_variance(fit)
        variance_factor = max(applied_factor * ratio, VARIANCE_FLOOR_PX2)
        # The factor applies to the samples' variances, not to the calibration's covariance:
        # refit with it. Without such a covariance the factor applies to everything.
        if not separable or abs(variance_factor / applied_factor - 1.0) < FACTOR_TOLERANCE:
            break
    each = _variance_ratio if estimated else lambda _fit: ratio
    averaged = average(problem, functions, penalties, each)
    return FittedCorrection(model, chosen, fit, averaged, applied_factor)


def _initial_variance(data: SensorData, parameter_transform: Array) -> float:
    """Return the mean squared residual of the camera's parameters alone [px^2], an upper bound."""
    parameter_jacobian = data.parameter_jacobian(data.points_mm) @ parameter_transform
    fitted = parameter_jacobian @ np.linalg.lstsq(parameter_jacobian, data.samples_px)[0]
    rest = data.samples_px - fitted
    dof = max(len(rest) - parameter_jacobian.shape[1], 1)
    return max(VARIANCE_FLOOR_PX2, float(rest @ rest) / float(dof))


def summarise_fit(
    data: SensorData, fitted: FittedCorrection, valid_share: float, coverage: Coverage
) -> SensorMapping:
    """Summarise a fit.

    Args:
        data: the samples.
        fitted: the fit.
        valid_share: share of the cells that the samples support.
        coverage: the samples' spacing and holes.
    """
    fit, average = fitted.fit, fitted.average
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
    correction = fitted.model.in_chunks(data.points_mm, lambda rows: rows @ average.amounts)
    return SensorMapping(
        data.name,
        len(data.samples_px),
        _rms(data.samples_px),
        _rms(data.samples_px - correction),
        _rms(errors),
        float((normalised_error**2).mean()),
        average.effective_parameters,
        float(fitted.chosen.weight * (1.0 if data.known_variance else fitted.variance_factor)),
        (x, y, z),
        float(np.sqrt(gcv_score(fit) / (fit.left_out().error ** 2).mean())),
        float(np.sqrt(data.variance_px2.mean() * (1.0 if data.known_variance else factor))),
        factor if data.known_variance else 1.0,
        valid_share,
        coverage.resolution_mm,
        coverage.largest_hole,
        describe_coverage(valid_share, coverage.resolution_mm, coverage.largest_hole),
        suspects,
    )


def _parameter_drift(data: SensorData) -> tuple[Array, Array]:
    """Return the transform of the camera's parameters to functions, and their prior precisions.

    Raises:
        TooFewPoints: no more points than parameters, of which no covariance is given.
        DegeneratePoints: the points leave a combination of the parameters open.
    """
    parameter_jacobian = data.parameter_jacobian(data.points_mm)
    if data.parameter_covariance is not None:
        values, vectors = np.linalg.eigh(data.parameter_covariance)
        parameter_transform = vectors * np.sqrt(np.maximum(values, 0.0))
        return parameter_transform, np.ones(parameter_transform.shape[1])
    count = parameter_jacobian.shape[1]
    if len(parameter_jacobian) <= count:
        raise TooFewPoints(
            f"sensor {data.name} saw {len(parameter_jacobian)} mapping points; they must determine "
            f"the errors of its calibration's {count} parameters: give at least {count + 1} "
            "points, or other points than the calibration's together with its covariance",
            sensor=data.name,
            points=len(parameter_jacobian),
        )
    whitened = parameter_jacobian / np.sqrt(data.variance_px2)[:, None]
    scale = np.linalg.norm(whitened, axis=0)
    # Leave out parameters without effect, as the offset along the slit without terms in v.
    acting = scale > 0.0
    _, singular, right = np.linalg.svd(whitened[:, acting] / scale[acting], full_matrices=False)
    if singular[-1] < MIN_SINGULAR_RATIO * singular[0]:
        raise DegeneratePoints(
            f"the {len(parameter_jacobian)} mapping points that sensor {data.name} saw leave a "
            f"combination of its calibration's parameters open (ratio of singular values "
            f"{singular[-1] / singular[0]:.1e}); add points at other positions and depths",
            sensor=data.name,
        )
    parameter_transform = np.zeros((count, len(singular)))
    parameter_transform[acting] = (right.T / singular) / scale[acting, None]
    return parameter_transform, np.full(len(singular), UNINFORMATIVE_PRECISION)


def _variance_ratio(fit: PenalisedFit) -> float:
    """Return the factor by which the samples' variances are too small, from the residuals."""
    return fit.residual_sum_of_squares / _residual_dof(fit)


def _excess_variance(fit: PenalisedFit) -> float:
    """Return the same for known variances: 1 unless the residuals contradict them."""
    wrong = fit.residual_sum_of_squares > chdtri(_residual_dof(fit), UNEXPLAINED_PROBABILITY)
    return _variance_ratio(fit) if wrong else 1.0


def _residual_dof(fit: PenalisedFit) -> float:
    return max(fit.problem.count - fit.effective_parameters, 1.0)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))

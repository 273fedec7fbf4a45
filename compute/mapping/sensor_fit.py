"""The penalised fit of one sensor's corrections, with the calibration's own error in it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from compute.errors import DegeneratePoints, TooFewPoints
from compute.mapping.averaged import AveragedFit, average
from compute.mapping.nodes import of_function
from compute.mapping.penalised import GROSS, PenalisedFit, PenalisedProblem
from compute.mapping.result import SensorMapping, Suspect
from compute.mapping.sensor_data import CHUNK, SensorData, blocks_tested, gather, rows_of
from compute.mapping.smooth_basis import SmoothBasis
from compute.mapping.smoothness import (
    Penalties,
    Smoothness,
    fit_with,
    gcv_score,
    single_penalty,
    weigh_penalties,
)

Array = NDArray[np.float64]

UNKNOWN_PRECISION = 1e-6
"""Of calibration errors that the measurements themselves must tell, in units of what they do."""
OPEN_RATIO = 1e-9
"""Ratio of singular values below which the measurements leave the calibration open."""
UNEXPLAINED_PROBABILITY = 0.01
"""Chance that right deviations are taken for too small."""
CONTRADICTED_PROBABILITY = 1e-4
"""Of the same by what left-out blocks say, which a field that is rough in places can say, too;
deviations that are half of the right ones go far beyond."""
MOST_TURNS = 8
"""Of fitting and of taking the samples' variances anew."""
SETTLED_FACTOR = 0.05
VARIANCE_FLOOR_PX2 = 1e-12
"""Exact measurements still leave rounding."""


@dataclass(frozen=True, eq=False)
class FittedCorrection:
    """A sensor's correction: splines and the calibration's error.

    Args:
        functions: the penalised functions.
        turn: makes of the camera's parameters the functions fitted beside, shape (P, Q).
        slopes: as in SensorData.
        chosen: the likeliest penalty and the fit with it.
        average: over the penalties.
        taken: by what the samples' variances were multiplied before the fit.
    """

    functions: SmoothBasis
    turn: Array
    slopes: Callable[[Array], Array]
    chosen: Smoothness
    average: AveragedFit
    taken: float

    @property
    def factor(self) -> float:
        """By what the samples' variances are to be multiplied, as the fit shows."""
        return self.taken * self.average.factor

    @property
    def coefficients_px(self) -> Array:
        """Cubic coefficients of the whole correction, shape (nx + 3, ny + 3, nz + 3) [px]."""
        amounts = self.average.amounts
        count = len(self.functions)
        by_camera = self.turn @ amounts[count:]
        return self.functions.coefficients(amounts[:count]) + of_function(
            self.functions.grid, lambda points: self.slopes(points) @ by_camera
        )

    def variance_px2(self, points_mm: Array) -> Array:
        """Return the variances of the expected readings at points (N, 3), shape (N,) [px^2]."""
        parts = []
        for start in range(0, len(points_mm), CHUNK):
            points = points_mm[start : start + CHUNK]
            rows = rows_of(self.functions, self.slopes(points) @ self.turn, points)
            parts.append(self.average.variance(rows))
        return np.concatenate(parts)


def fit_sensor(
    data: SensorData,
    functions: SmoothBasis,
    smoothness: float | None,
    told: Callable[[], None],
) -> FittedCorrection:
    """Fit one sensor's corrections.

    What is corrected is ``J delta + m``: the calibrated camera is off by delta, and a camera of
    its kind is off the real one by a smooth m. Both are fitted at once (kriging with a drift; N.
    A. C. Cressie, Statistics for Spatial Data, 1993, section 3.4), so that the variance of the
    sum is that of the expected reading, and nothing is counted twice.

    Raises:
        TooFewPoints, DegeneratePoints: the measurements cannot tell the calibration's error.
    """
    turn, precision = _drift(data)
    contradiction = float(chdtri(1.0, 2.0 * CONTRADICTED_PROBABILITY))  # too small ones alone
    told_apart = data.parameter_covariance is not None
    taken = _first_variance(data, turn) if told_apart and not data.known_variance else 1.0
    for _ in range(MOST_TURNS):
        counted = taken
        scaled = replace(data, variance_px2=data.variance_px2 * counted)
        problem = gather(scaled, functions, turn, precision)

        def weighed(problem: PenalisedProblem, counted: float = counted) -> Penalties:
            if smoothness is None:
                return weigh_penalties(problem, functions, told)
            # Where the variances are not known, the weight is in units of theirs.
            weight = smoothness if data.known_variance else smoothness / counted
            return single_penalty(problem, functions, weight)

        penalties = weighed(problem)
        estimated = not data.known_variance or counted != 1.0
        if problem.known_variance and penalties.contradict(contradiction):
            estimated = True
            problem = replace(problem, known_variance=False)
            penalties = weighed(problem)
        likeliest = penalties.trials[penalties.best]
        chosen = fit_with(problem, functions, likeliest.weight, likeliest.axes)
        ratio = _ratio(chosen.fit) if estimated else _unexplained(chosen.fit)
        taken = max(counted * ratio, VARIANCE_FLOOR_PX2)
        # The samples' variances have a factor, the calibration's own have none: they are weighed
        # anew. Where the measurements alone tell both, the factor is all's.
        if not told_apart or abs(taken / counted - 1.0) < SETTLED_FACTOR:
            break
    each = _ratio if estimated else lambda _fit: ratio
    averaged = average(problem, functions, penalties, each)
    return FittedCorrection(functions, turn, data.slopes, chosen, averaged, counted)


def _first_variance(data: SensorData, turn: Array) -> float:
    """Return what a camera of its kind leaves of the samples at most, by their count [px^2]."""
    slopes = data.slopes(data.points_mm) @ turn
    rest = data.samples_px - slopes @ np.linalg.lstsq(slopes, data.samples_px)[0]
    freedom = max(len(rest) - slopes.shape[1], 1)
    left = float(rest @ rest) / float(freedom)
    return left if left > VARIANCE_FLOOR_PX2 else VARIANCE_FLOOR_PX2


def describe(data: SensorData, fitted: FittedCorrection, valid_share: float) -> SensorMapping:
    """Return the figures of a fit."""
    fit, average = fitted.chosen.fit, fitted.average
    order, _ = blocks_tested(data.block)
    sigmas = np.abs(average.error) / average.deviation
    errors = average.error * np.sqrt(data.variance_px2[order] * fitted.taken)
    worst = np.argsort(-sigmas, kind="stable")[: int((sigmas > GROSS).sum())]
    suspects = tuple(
        Suspect(int(data.numbers[order[one]]), float(errors[one]), float(sigmas[one]))
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
        float((sigmas**2).mean()),
        average.effective_parameters,
        float(fitted.chosen.weight * (1.0 if data.known_variance else fitted.taken)),
        (x, y, z),
        float(np.sqrt(gcv_score(fit) / (fit.left_out().error ** 2).mean())),
        float(np.sqrt(data.variance_px2.mean() * (1.0 if data.known_variance else factor))),
        factor if data.known_variance else 1.0,
        valid_share,
        suspects,
    )


def _drift(data: SensorData) -> tuple[Array, Array]:
    """Return what makes functions of the camera's parameters, and their prior precisions."""
    slopes = data.slopes(data.points_mm)
    if data.parameter_covariance is not None:
        values, vectors = np.linalg.eigh(data.parameter_covariance)
        turn = vectors * np.sqrt(np.maximum(values, 0.0))
        return turn, np.ones(turn.shape[1])
    count = slopes.shape[1]
    if len(slopes) <= count:
        raise TooFewPoints(
            f"sensor {data.name} saw {len(slopes)} mapping points and its calibration has "
            f"{count} parameters, whose errors they are to tell; give at least {count + 1} "
            "points, or other points than the calibration's together with its covariance",
            sensor=data.name,
            points=len(slopes),
        )
    whitened = slopes / np.sqrt(data.variance_px2)[:, None]
    scale = np.linalg.norm(whitened, axis=0)
    # What no reading depends on, as the place along the slit where no term has v in it.
    acting = scale > 0.0
    _, singular, right = np.linalg.svd(whitened[:, acting] / scale[acting], full_matrices=False)
    if singular[-1] < OPEN_RATIO * singular[0]:
        raise DegeneratePoints(
            f"the {len(slopes)} mapping points that sensor {data.name} saw leave a combination of "
            f"its calibration's parameters open (ratio of singular values "
            f"{singular[-1] / singular[0]:.1e}); add points at other places and depths",
            sensor=data.name,
        )
    turn = np.zeros((count, len(singular)))
    turn[acting] = (right.T / singular) / scale[acting, None]
    return turn, np.full(len(singular), UNKNOWN_PRECISION)


def _residuals(data: SensorData, fitted: FittedCorrection) -> Array:
    """Return what the fit leaves of the samples, shape (N,) [px]."""
    parts = []
    for start in range(0, len(data.points_mm), CHUNK):
        points = data.points_mm[start : start + CHUNK]
        rows = rows_of(fitted.functions, data.slopes(points) @ fitted.turn, points)
        parts.append(rows @ fitted.average.amounts)
    rest: Array = data.samples_px - np.concatenate(parts)
    return rest


def _ratio(fit: PenalisedFit) -> float:
    """Return by what the samples' variances are too small, from the residuals."""
    return fit.residual_square / _freedom(fit)


def _unexplained(fit: PenalisedFit) -> float:
    """Return the same of known variances, which hold as long as no residuals contradict them."""
    wrong = fit.residual_square > chdtri(_freedom(fit), UNEXPLAINED_PROBABILITY)
    return _ratio(fit) if wrong else 1.0


def _freedom(fit: PenalisedFit) -> float:
    return max(fit.problem.count - fit.effective_parameters, 1.0)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))

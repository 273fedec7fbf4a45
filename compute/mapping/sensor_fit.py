"""The penalised fit of one sensor's corrections, with the calibration's own error in it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from compute.errors import DegeneratePoints, TooFewPoints
from compute.mapping.nodes import of_function
from compute.mapping.penalised import GROSS, PenalisedProblem
from compute.mapping.result import SensorMapping, Suspect
from compute.mapping.smooth_basis import SmoothBasis
from compute.mapping.smoothness import Smoothness, choose_smoothness, fit_with, gcv_score

Array = NDArray[np.float64]

UNKNOWN_PRECISION = 1e-6
"""Of calibration errors that the measurements themselves must tell, in units of what they do."""
OPEN_RATIO = 1e-9
"""Ratio of singular values below which the measurements leave the calibration open."""
UNEXPLAINED_PROBABILITY = 0.01
"""Chance that right deviations are taken for too small."""
BLOCKS_TESTED = 2000
"""Blocks that are left out in turn, at most; of more, these are spread evenly over all."""
MOST_TURNS = 8
"""Of fitting and of taking the samples' variances anew."""
SETTLED_FACTOR = 0.05
VARIANCE_FLOOR_PX2 = 1e-12
"""Exact measurements still leave rounding."""
_CHUNK = 4096


@dataclass(frozen=True, eq=False)
class SensorData:
    """What is fitted of one sensor.

    Args:
        name: of the sensor.
        points_mm: measurements that it saw, shape (N, 3) [mm].
        numbers: theirs among all measurements, shape (N,).
        samples_px: projection less measurement, shape (N,) [px].
        variance_px2: of the measurements, shape (N,) [px^2]; ones where not known.
        known_variance: whether they are known.
        block: number of each measurement's block, shape (N,).
        slopes: d reading / d parameters of the sensor at points (M, 3), shape (M, P).
        parameter_covariance: of the sensor's parameters, from other measurements, shape (P, P);
            None: these measurements made the calibration.
    """

    name: str
    points_mm: Array
    numbers: NDArray[np.intp]
    samples_px: Array
    variance_px2: Array
    known_variance: bool
    block: NDArray[np.intp]
    slopes: Callable[[Array], Array]
    parameter_covariance: Array | None


@dataclass(frozen=True, eq=False)
class FittedCorrection:
    """A sensor's correction: splines and the calibration's error.

    Args:
        functions: the penalised functions.
        turn: makes of the camera's parameters the functions fitted beside, shape (P, Q).
        slopes: as in SensorData.
        chosen: the penalty and the fit.
        taken: by what the samples' variances were multiplied before the fit.
        factor: by what they are to be multiplied, as the fit shows.
    """

    functions: SmoothBasis
    turn: Array
    slopes: Callable[[Array], Array]
    chosen: Smoothness
    taken: float
    factor: float

    @property
    def rest(self) -> float:
        """Factor that the fit's own variances lack."""
        return self.factor / self.taken

    @property
    def coefficients_px(self) -> Array:
        """Cubic coefficients of the whole correction, shape (nx + 3, ny + 3, nz + 3) [px]."""
        amounts = self.chosen.fit.amounts
        count = len(self.functions)
        by_camera = self.turn @ amounts[count:]
        return self.functions.coefficients(amounts[:count]) + of_function(
            self.functions.grid, lambda points: self.slopes(points) @ by_camera
        )

    def variance_px2(self, points_mm: Array) -> Array:
        """Return the variances of the expected readings at points (N, 3), shape (N,) [px^2]."""
        parts = []
        for start in range(0, len(points_mm), _CHUNK):
            points = points_mm[start : start + _CHUNK]
            rows = _rows(self.functions, self.slopes(points) @ self.turn, points)
            parts.append(self.chosen.fit.variance(rows))
        return self.rest * np.concatenate(parts)


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
    told_apart = data.parameter_covariance is not None
    taken = _first_variance(data, turn) if told_apart and not data.known_variance else 1.0
    for _ in range(MOST_TURNS):
        counted = taken
        scaled = replace(data, variance_px2=data.variance_px2 * counted)
        problem = _problem(scaled, functions, turn, precision)
        if smoothness is None:
            chosen = choose_smoothness(problem, functions, told)
        else:
            # Where the variances are not known, the weight is in units of theirs.
            weight = smoothness if data.known_variance else smoothness / counted
            chosen = fit_with(problem, functions, weight, np.ones(3))
        ratio = _factor(scaled, chosen, doubted=counted != 1.0)
        taken = max(counted * ratio, VARIANCE_FLOOR_PX2)
        # The samples' variances have a factor, the calibration's own have none: they are weighed
        # anew. Where the measurements alone tell both, the factor is all's.
        if not told_apart or abs(taken / counted - 1.0) < SETTLED_FACTOR:
            break
    return FittedCorrection(functions, turn, data.slopes, chosen, counted, counted * ratio)


def _first_variance(data: SensorData, turn: Array) -> float:
    """Return what a camera of its kind leaves of the samples at most, by their count [px^2]."""
    slopes = data.slopes(data.points_mm) @ turn
    rest = data.samples_px - slopes @ np.linalg.lstsq(slopes, data.samples_px)[0]
    freedom = max(len(rest) - slopes.shape[1], 1)
    left = float(rest @ rest) / float(freedom)
    return left if left > VARIANCE_FLOOR_PX2 else VARIANCE_FLOOR_PX2


def describe(data: SensorData, fitted: FittedCorrection, valid_share: float) -> SensorMapping:
    """Return the figures of a fit."""
    fit = fitted.chosen.fit
    left_out = fit.left_out()
    order, _ = _tested(data.block)
    sigmas = np.abs(left_out.error) / (left_out.deviation * np.sqrt(fitted.rest))
    errors = left_out.error * np.sqrt(data.variance_px2[order] * fitted.taken)
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
        float((left_out.unit**2).mean()) / fitted.rest,
        fit.effective_parameters,
        float(fitted.chosen.weight * (1.0 if data.known_variance else fitted.taken)),
        (x, y, z),
        float(np.sqrt(gcv_score(fit) / (left_out.error**2).mean())),
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


def _problem(
    data: SensorData, functions: SmoothBasis, turn: Array, precision: Array
) -> PenalisedProblem:
    """Gather the normal equations, chunk by chunk, and the blocks to leave out."""
    weight = 1.0 / np.sqrt(data.variance_px2)
    size = len(functions) + turn.shape[1]
    gram, product = np.zeros((size, size)), np.zeros(size)
    for start in range(0, len(weight), _CHUNK):
        part = slice(start, start + _CHUNK)
        rows = _whitened_rows(data, functions, turn, np.arange(len(weight))[part])
        gram += rows.T @ rows
        product += rows.T @ (data.samples_px[part] * weight[part])
    order, sizes = _tested(data.block)
    tested = _whitened_rows(data, functions, turn, order)
    square = float(((data.samples_px * weight) ** 2).sum())
    return PenalisedProblem(
        gram,
        product,
        square,
        len(weight),
        precision,
        tested,
        data.samples_px[order] * weight[order],
        sizes,
        data.known_variance,
    )


def _tested(block: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the measurements of the blocks that are left out, block after block, and sizes."""
    numbers, sizes = np.unique(block, return_counts=True)
    if len(numbers) > BLOCKS_TESTED:
        spread = np.linspace(0, len(numbers) - 1, BLOCKS_TESTED).astype(np.intp)
        numbers, sizes = numbers[spread], sizes[spread]
    order = np.argsort(block, kind="stable")
    return order[np.isin(block[order], numbers)], sizes


def _whitened_rows(
    data: SensorData, functions: SmoothBasis, turn: Array, index: NDArray[np.intp]
) -> Array:
    points = data.points_mm[index]
    rows = _rows(functions, data.slopes(points) @ turn, points)
    return rows / np.sqrt(data.variance_px2[index])[:, None]


def _rows(functions: SmoothBasis, by_camera: Array, points_mm: Array) -> Array:
    return np.concatenate([functions.values(points_mm), by_camera], axis=1)


def _residuals(data: SensorData, fitted: FittedCorrection) -> Array:
    """Return what the fit leaves of the samples, shape (N,) [px]."""
    parts = []
    for start in range(0, len(data.points_mm), _CHUNK):
        points = data.points_mm[start : start + _CHUNK]
        rows = _rows(fitted.functions, data.slopes(points) @ fitted.turn, points)
        parts.append(rows @ fitted.chosen.fit.amounts)
    rest: Array = data.samples_px - np.concatenate(parts)
    return rest


def _factor(data: SensorData, chosen: Smoothness, *, doubted: bool) -> float:
    """Return by what the variances are too small, from the residuals.

    Known ones are held for right as long as the residuals do not contradict them; ``doubted``:
    they have.
    """
    fit = chosen.fit
    freedom = max(len(data.samples_px) - fit.effective_parameters, 1.0)
    ratio = fit.residual_square / freedom
    if not data.known_variance or doubted:
        return ratio
    return ratio if fit.residual_square > chdtri(freedom, UNEXPLAINED_PROBABILITY) else 1.0


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))

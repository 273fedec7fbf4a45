"""Monte Carlo errors of position estimators of one peak, relative to the Cramer-Rao bound."""

from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.centroid_settings import CentroidSettings, Weighting
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.window_model import WindowModel, Windows
from compute.signal.peaks import PeakBatch, PeakFlag
from validation.joint_position_bounds import joint_position_bounds
from validation.synthetic_scans import (
    AMBIENT,
    GAIN,
    MIDDLE_PX,
    OFFSET,
    PIXELS,
    Array,
    Nearest,
    expose,
    find,
    gaussian_electrons,
    line_noise,
    nearest,
    places_px,
)

WIDTHS_PX: Final = (0.6, 1.0, 2.0, 3.0)
LIGHTS: Final = (1e3, 1e4, 1e5)
READ_NOISES: Final = (5.0, 20.0, 50.0)
PHASES: Final = 16
"""Parts of a pixel over which the bias is looked at."""

KNOWN_WIDTH, FITTED, PRIOR = "width known", "width fitted", "width within 10 %"
DEFAULT = "as it comes"
"""FitSettings without a word: next to nothing is known of the width."""
GRAVITY, EDGE = "centre of gravity", "edge-corrected"
WRONG_WIDTH: Final = 1.05
"""Of PRIOR: the width is believed so many times the true one, give or take 10 %."""

_WEIGHTINGS: Final[dict[str, Weighting]] = {GRAVITY: "above-threshold", EDGE: "edge-corrected"}
_REACH_WIDTHS: Final = 6.0


@dataclass(frozen=True)
class Setting:
    """One line: its deviation [px], its light and the read noise [electrons]."""

    width_px: float
    light: float
    read_noise: float


SETTINGS: Final = tuple(Setting(*each) for each in product(WIDTHS_PX, LIGHTS, READ_NOISES))


@dataclass(frozen=True)
class Errors:
    """An estimator's errors.

    Args:
        count: lines that it was measured by.
        rms_px: root mean square.
        bias_px: mean error in that part of a pixel where it is largest, absolute.
        bias_error_px: its standard error.
        nees: mean of the squared errors in stated standard deviations.
        unfitted: share of lines that could not be fitted.
        split: share of lines in which it saw more than one.
    """

    count: int
    rms_px: float
    bias_px: float
    bias_error_px: float
    nees: float
    unfitted: float
    split: float


@dataclass(frozen=True)
class Efficiency:
    """What was measured for a setting.

    Args:
        setting: the line.
        strict_px: bound where nothing but the position is unknown: DESIGN's formula.
        bound_px: bound where light, background and width are unknown too.
        found: share of lines in which the search found a peak.
        errors: by the estimators' names.
    """

    setting: Setting
    strict_px: float
    bound_px: float
    found: float
    errors: dict[str, Errors]


def fit_settings(name: str, width_px: float) -> FitSettings:
    """Return what an estimator knows of the width."""
    if name == KNOWN_WIDTH:
        return FitSettings(width_px=width_px, width_log_sigma=0.0)
    if name == DEFAULT:
        return FitSettings()
    if name == FITTED:
        return FitSettings(width_px=width_px, width_log_sigma=np.inf)
    return FitSettings(width_px=WRONG_WIDTH * width_px, width_log_sigma=0.1)


@cache
def efficiency(setting: Setting, count: int, seed: int = 1) -> Efficiency:
    """Measure all estimators by the same lines, at places all over a pixel.

    Args:
        setting: the line.
        count: number of lines.
        seed: of the noise.
    """
    width, light, read = setting.width_px, setting.light, setting.read_noise
    rng = np.random.default_rng([seed, round(100 * width), round(light), round(read)])
    position = places_px(count, rng)
    electrons = gaussian_electrons(position[:, None], width, (light,))
    lines = expose(electrons, read, rng)
    noise, known = line_noise(read), fit_settings(KNOWN_WIDTH, width)
    strict, nuisance = (
        joint_position_bounds(
            position[:: max(count // 64, 1), None], [light], AMBIENT, PIXELS,
            fit_settings(FITTED, width), noise, only_positions=only,
        ).mean()
        ** 0.5
        for only in (True, False)
    )  # fmt: skip
    first_order, of_free = (
        first_order_errors(setting, position, lines, width_known=known) for known in (True, False)
    )
    amplitude = float(electrons.max(axis=1).mean()) / GAIN
    errors = {}
    start = nearest(find(lines, known.search, read), position, width, amplitude, rng)
    for name in (KNOWN_WIDTH, FITTED, PRIOR, DEFAULT):
        fitted = fit_scans(lines, fit_settings(name, width), noise, candidates=start.peaks)
        given = first_order if name == KNOWN_WIDTH else of_free
        errors[name] = errors_of(match_true_peaks(fitted, position), fitted, position, given)
    for name, weighting in _WEIGHTINGS.items():
        settings = CentroidSettings(weighting=weighting, min_width_px=1)
        centre = nearest(find(lines, settings, read), position, width, amplitude, rng)
        errors[name] = _gravity_errors(centre, position, first_order)
    return Efficiency(setting, float(strict), float(nuisance), float(start.found.mean()), errors)


def first_order_errors(
    setting: Setting, position: Array, lines: NDArray[np.uint16], *, width_known: bool
) -> Array:
    """Return what noise does to the best estimate to first order; its mean is zero.

    Subtracted from an estimator's errors it takes most of the chance out of their mean, and
    leaves the bias: a control variate.
    """
    known = fit_settings(KNOWN_WIDTH, setting.width_px)
    model, parameters = true_parameters(setting, known, position)
    half = int(np.ceil(_REACH_WIDTHS * setting.width_px)) + 2
    each = np.ones(len(position), dtype=np.int64)
    windows = Windows.cut(
        lines,
        np.arange(len(position)),
        (MIDDLE_PX - half) * each,
        (MIDDLE_PX + half) * each,
        line_noise(setting.read_noise),
    )
    expected = model.evaluate(windows, parameters)
    jacobian = expected.jacobian[:, :-1] if width_known else expected.jacobian
    weighted = jacobian / expected.variance[:, None]
    score = (weighted @ (windows.values - expected.mean)[..., None])[..., 0]
    step = np.linalg.solve(weighted @ jacobian.transpose(0, 2, 1), score[..., None])
    return np.asarray(step[:, model.position.start, 0])


def true_parameters(
    setting: Setting, settings: FitSettings, position: Array
) -> tuple[WindowModel, Array]:
    """Return the model of single lines, and its parameters at these places, shape (N, Q)."""
    model = WindowModel(1, settings, LineSpreadFunction.gaussian())
    parameters = np.zeros((len(position), model.size))
    parameters[:, 0] = OFFSET + AMBIENT / GAIN
    parameters[:, model.light] = setting.light / GAIN
    parameters[:, model.position] = position[:, None]
    parameters[:, -1] = np.log(setting.width_px)
    return model, parameters


def match_true_peaks(found: PeakBatch, position: Array) -> NDArray[np.int64]:
    """Return the number of the peak nearest to each true place."""
    error = np.abs(found.position_px - position[:, None])
    return np.asarray(np.argmin(np.where(np.isnan(error), np.inf, error), axis=1))


def errors_of(
    own: NDArray[np.int64], found: PeakBatch, position: Array, first_order: Array
) -> Errors:
    """Return the errors of peaks ``own`` of lines at true places."""
    row = np.arange(len(own))
    error = found.position_px[row, own] - position
    bias, bias_error = largest_bias(error, position, first_order)
    return Errors(
        len(error),
        float(np.sqrt(np.mean(error**2))),
        bias,
        bias_error,
        float(np.mean((error / found.sigma_px[row, own]) ** 2)),
        float(np.mean((found.flags[row, own] & PeakFlag.UNFITTED) != 0)),
        float(np.mean(found.count > 1)),
    )


def largest_bias(error: Array, position: Array, first_order: Array) -> tuple[float, float]:
    """Return the largest mean error over the parts of a pixel, absolute, and its standard error."""
    part = np.floor((position + 0.5) % 1.0 * PHASES).astype(np.int64)
    rest = error - first_order
    count = np.bincount(part, minlength=PHASES)
    mean = np.bincount(part, rest, PHASES) / count
    nees = np.bincount(part, rest**2, PHASES) / count
    worst = int(np.argmax(np.abs(mean)))
    spread = np.sqrt(max(nees[worst] - mean[worst] ** 2, 0.0) / count[worst])
    return float(abs(mean[worst])), float(spread)


def _gravity_errors(centre: Nearest, position: Array, first_order: Array) -> Errors:
    """Return the errors of centres of gravity, of the lines in which one was found."""
    some = centre.found
    if some.sum() < PHASES * 10:
        return Errors(int(some.sum()), *(np.nan,) * 6)
    found = PeakBatch(**{name: values[some] for name, values in vars(centre.peaks).items()})
    own = np.zeros(len(found), dtype=np.int64)
    return errors_of(own, found, position[some], first_order[some])

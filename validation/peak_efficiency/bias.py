"""Bias of the fit of a faint peak: simulated, and as theory predicts."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.window_model import Windows
from compute.signal.peaks import PeakBatch
from validation.joint_position_bounds import joint_position_bounds
from validation.peak_efficiency.monte_carlo import (
    KNOWN_WIDTH,
    Errors,
    Setting,
    errors_of,
    first_order_errors,
    fit_settings,
    match_true_peaks,
    true_parameters,
)
from validation.synthetic_scans import (
    AMBIENT,
    MIDDLE_PX,
    PIXELS,
    Array,
    expose,
    gaussian_electrons,
    line_noise,
    places_px,
)

MIN_BIAS_PX: Final = 0.002
MIN_BIAS: Final = 0.02
"""Biases up to the one, or to this part of the bound, are nothing."""

FAINT: Final = (
    *(Setting(0.6, 1e3, read) for read in (5.0, 20.0, 50.0)),
    *(Setting(0.6, light, 50.0) for light in (2e3, 3e3)),
    *(Setting(width, 1e3, 50.0) for width in (0.7, 0.8, 1.0)),
    Setting(2.0, 1e3, 20.0),
)
"""Where there may be a bias, on the table of case peak-efficiency and between its rows."""

_BLOCK: Final = 4000
_WAVES: Final = 3
_NEAR_WIDTHS: Final = 3.0  # a peak so near is the line's
_STEP: Final = 1e-2  # of parameters in their own units, for derivatives
_PLACES: Final = 64


@dataclass(frozen=True)
class Bias:
    """What an estimator errs by on the mean.

    Args:
        setting: the line.
        strict_px: bound where nothing but the position is unknown.
        found: share of lines in which the search found a peak; only these count.
        errors: measured.
        bias_px: the largest mean error within a pixel, by waves over it, absolute.
        bias_error_px: its standard error.
        second_order_px: the largest bias within a pixel that is expected to second order.
    """

    setting: Setting
    strict_px: float
    found: float
    errors: Errors
    bias_px: float
    bias_error_px: float
    second_order_px: float

    @property
    def allowed_px(self) -> float:
        """Up to which a bias is nothing."""
        return max(MIN_BIAS_PX, MIN_BIAS * self.strict_px)


@cache
def bias_figures(setting: Setting, name: str, count: int, seed: int = 1) -> Bias:
    """Measure the kernel's fits of so many lines at places all over a pixel.

    Args:
        setting: the line.
        name: what the fit knows of its width: KNOWN_WIDTH, FITTED, ...
        count: number of lines.
        seed: of the noise.
    """
    width, read = setting.width_px, setting.read_noise
    rng = np.random.default_rng([seed, round(100 * width), round(setting.light), round(read)])
    noise, settings = line_noise(read), fit_settings(name, width)
    finder = FitFinder(_BLOCK, PIXELS, settings, noise, device="cpu", threads=1)
    position = places_px(count, rng)
    first_order = np.zeros(count)
    parts = []
    for begin in range(0, count, _BLOCK):
        some = slice(begin, min(begin + _BLOCK, count))
        lines = expose(gaussian_electrons(position[some, None], width, (setting.light,)), read, rng)
        first_order[some] = first_order_errors(
            setting, position[some], lines, width_known=name == KNOWN_WIDTH
        )
        parts.append(vars(finder.find(lines)))
    found = PeakBatch(**{key: np.concatenate([part[key] for part in parts]) for key in parts[0]})
    own = match_true_peaks(found, position)
    error = found.position_px[np.arange(count), own] - position
    near = np.abs(error) < _NEAR_WIDTHS * max(width, 1.0)
    some_found = PeakBatch(**{key: values[near] for key, values in vars(found).items()})
    positions = MIDDLE_PX + (np.arange(_PLACES) + 0.5) / (2 * _PLACES)
    strict = joint_position_bounds(
        positions[:, None],
        [setting.light],
        AMBIENT,
        PIXELS,
        fit_settings(KNOWN_WIDTH, width),
        noise,
        only_positions=True,
    )
    return Bias(
        setting,
        float(strict.mean() ** 0.5),
        float(near.mean()),
        errors_of(own[near], some_found, position[near], first_order[near]),
        *largest_of_waves((error - first_order)[near], position[near]),
        float(np.abs(second_order_bias(setting, settings, positions)).max()),
    )


def largest_of_waves(error: Array, position: Array) -> tuple[float, float]:
    """Return the largest mean error within a pixel, absolute, and its standard error.

    By a constant and three waves over the pixel: the bias of a fit is smooth, and seven means tell
    it better than those of sixteen parts.
    """

    def waves(at: Array) -> Array:
        angles = 2.0 * np.pi * at[:, None] * np.arange(1, _WAVES + 1)
        return np.concatenate([np.ones((len(at), 1)), np.sin(angles), np.cos(angles)], axis=1)

    given, grid = waves(position), waves(np.linspace(0.0, 1.0, 4 * _PLACES, endpoint=False))
    inverse = np.linalg.inv(given.T @ given)
    found = inverse @ (given.T @ error)
    spread = np.std(error - given @ found)
    curve = grid @ found
    worst = int(np.argmax(np.abs(curve)))
    return float(abs(curve[worst])), float(spread * np.sqrt(grid[worst] @ inverse @ grid[worst]))


def second_order_bias(setting: Setting, settings: FitSettings, position: Array) -> Array:
    """Return the bias of second order of fits at these places, shape (N,) [px].

    ``C (p - J'WH/2)``: C the inverse of information with prior, p the prior's slope, J the model's
    first derivatives, W the inverse variances, and H its second derivatives times the errors'
    covariance, summed (M. J. Box, 10.1111/j.2517-6161.1971.tb00871.x; that variances follow the
    model adds nothing to it). In the window that a fit begins with.
    """
    model, parameters = true_parameters(setting, settings, position)
    half = int(np.ceil(settings.reach * setting.width_px)) + 1
    centre = np.floor(position + 0.5).astype(np.int64)
    windows = Windows.cut(
        np.zeros((1, PIXELS), np.uint16),
        np.zeros(len(position), np.int64),
        centre - half,
        centre + half,
        line_noise(setting.read_noise),
    )
    free = model.size - (settings.width_log_sigma == 0.0)

    def jacobian(at: Array) -> tuple[Array, Array]:
        expected = model.evaluate(windows, at)
        return expected.jacobian[:, :free], expected.variance

    first, variance = jacobian(parameters)
    weighted = first / variance[:, None]
    information = weighted @ first.transpose(0, 2, 1)
    prior = model.width_prior(parameters[:, -1])
    expected, slope = information.copy(), np.zeros(first.shape[:2])
    if free == model.size:
        expected[:, -1, -1] += prior.information
        slope[:, -1] = prior.score
    inverse = np.linalg.inv(expected)
    covariance = inverse @ information @ inverse
    bent = np.zeros_like(variance)
    for number in range(free):
        step = np.zeros(model.size)
        step[number] = _STEP
        second = (jacobian(parameters + step)[0] - jacobian(parameters - step)[0]) / (2 * _STEP)
        bent += (covariance[:, number, :, None] * second).sum(axis=1)
    slope -= 0.5 * (weighted @ bent[..., None])[..., 0]
    return np.asarray((inverse @ slope[..., None])[:, model.position.start, 0])

"""Alignment in time: a bar's readings at the time of another bar's exposure.

Bars expose at different times. A reading of the exposure next to the wanted time is moved there by
the parabola through the same peak's readings in the exposures before and after it. Each raw reading
then counts once in the long run: the three weights always sum to one.
"""

from dataclasses import dataclass
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.parameter_checks import require

Array = NDArray[np.float64]

MAX_SIGMA_PX: Final = 1.0
"""A reading that is less certain than this at the wanted time is left out."""
_GATE_SIGMA: Final = 4.0


@dataclass(frozen=True)
class AlignmentSettings:
    """How fast a peak may move on a sensor.

    Args:
        max_rate_px_s: fastest peak [px/s]; 10 000 are 5 m/s at 2 px/mm.
        max_acceleration_px_s2: largest acceleration of a peak [px/s^2].

    Raises:
        InvalidParameter: a value is not positive and finite.
    """

    max_rate_px_s: float = 1e4
    max_acceleration_px_s2: float = 1e5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(0.0 < value < inf, "be positive and finite", **{name: value})


STANDARD: Final = AlignmentSettings()


@dataclass(frozen=True, eq=False)
class AlignedReadings:
    """K readings of each of S sensors, moved to one time; NaN where there is none.

    Args:
        position_px: shape (S, K) [px].
        variance_px2: of the position, by the noise of the readings that it comes from and by what
            is not known of the motion, shape (S, K) [px^2].
        rate_px_s: how fast the reading changes, shape (S, K) [px/s]; 0 where that is not known,
            which the variance then holds.
        rate_variance_px2_s2: variance of the rate by noise, shape (S, K) [px^2/s^2].
        covariance_px2_s: covariance of position and rate, shape (S, K) [px^2/s].
    """

    position_px: Array
    variance_px2: Array
    rate_px_s: Array
    rate_variance_px2_s2: Array
    covariance_px2_s: Array


def align(
    time_s: tuple[float, float, float],
    position_px: Array,
    variance_px2: Array,
    settings: AlignmentSettings = STANDARD,
) -> AlignedReadings:
    """Return the readings of an exposure at another time.

    A peak is found again in the exposures before and after by its rate and acceleration, which are
    small; two peaks that claim the same one have it neither. With one of both exposures the reading
    is moved along a straight line, with none it is left where it is: the variance holds what that
    may cost.

    Args:
        time_s: the exposure before, the exposure, and the one after, from the wanted time on [s],
            in this order and all different.
        position_px: peaks of these three exposures, shape (3, S, K) [px]; NaN: none.
        variance_px2: their variances, shape (3, S, K) [px^2].
        settings: how fast peaks may move.

    Returns:
        Readings at the indices of the peaks of the exposure in the middle.

    Raises:
        InvalidParameter: the times do not rise.
    """
    before_s, at_s, after_s = time_s
    require(before_s < at_s < after_s, "rise", time_s=time_s)
    ahead = -at_s
    earlier, later = before_s - at_s, after_s - at_s
    position, variance = position_px[1], variance_px2[1]
    before, after, through = _match((earlier, later), position_px, variance_px2, settings)
    rows = np.arange(len(position))[:, None]
    curved = _along_parabola((earlier, later), ahead, position_px, variance_px2, before, after)
    if through.all() and (curved[1] <= MAX_SIGMA_PX**2).all():
        return AlignedReadings(*curved)
    # Not found again.
    seen = np.isfinite(position)
    unmoved = np.where(seen, variance + (settings.max_rate_px_s / 3.0 * ahead) ** 2, np.nan)
    nothing = np.zeros(position.shape)
    found = np.stack([np.where(seen, position, np.nan), unmoved, nothing, nothing, nothing])

    # In one of both: the straight line.
    for index, step, partner in ((0, earlier, before), (2, later, after)):
        part = ahead / step
        along = _combine(
            (1.0 - part, part),
            (-1.0 / step, 1.0 / step),
            (position, position_px[index][rows, partner]),
            (variance, variance_px2[index][rows, partner]),
        )
        bend = settings.max_acceleration_px_s2 / 6.0 * ahead * (ahead - step)
        along[1] += bend**2
        better = (partner >= 0) & (along[1] < found[1])
        found[:, better] = along[:, better]

    # In both.
    found[:, through] = curved[:, through]

    vague = ~(found[1] <= MAX_SIGMA_PX**2)
    found[:2, vague], found[2:, vague] = np.nan, 0.0
    return AlignedReadings(*found)


def _along_parabola(
    steps_s: tuple[float, float],
    ahead: float,
    position_px: Array,
    variance_px2: Array,
    before: NDArray[np.intp],
    after: NDArray[np.intp],
) -> Array:
    """Return readings along the parabola through the peaks of three exposures; as ``_combine``."""
    earlier, later = steps_s
    rows = np.arange(position_px.shape[1])[:, None]
    position, variance = position_px[1], variance_px2[1]
    apart = later - earlier
    divisors = (-earlier * apart, earlier * later, later * apart)
    weights = (ahead * (ahead - later), (ahead - earlier) * (ahead - later),
               ahead * (ahead - earlier))  # fmt: skip
    slopes = (2.0 * ahead - later, 2.0 * ahead - earlier - later, 2.0 * ahead - earlier)
    return _combine(
        tuple(weight / divisor for weight, divisor in zip(weights, divisors, strict=True)),
        tuple(slope / divisor for slope, divisor in zip(slopes, divisors, strict=True)),
        (position_px[0][rows, before], position, position_px[2][rows, after]),
        (variance_px2[0][rows, before], variance, variance_px2[2][rows, after]),
    )


def _combine(
    weights: tuple[float, ...],
    slopes: tuple[float, ...],
    positions: tuple[Array, ...],
    variances: tuple[Array, ...],
) -> Array:
    """Return position, variance, rate, its variance, and their covariance, shape (5, S, K)."""
    total: Array = np.zeros((5, *positions[0].shape))
    for weight, slope, position, variance in zip(
        weights, slopes, positions, variances, strict=True
    ):
        total[0] += weight * position
        total[1] += weight**2 * variance
        total[2] += slope * position
        total[3] += slope**2 * variance
        total[4] += weight * slope * variance
    return total


def _match(
    steps_s: tuple[float, float],
    position_px: Array,
    variance_px2: Array,
    settings: AlignmentSettings,
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Find each peak of the exposure in the middle in the exposures before and after it.

    Returns:
        Index of the peak before and after, -1: none; and which were found as one parabola, each
        of shape (S, K).
    """
    earlier, later = steps_s
    middle = position_px[1]
    sigma_rate = settings.max_rate_px_s / 3.0
    sigma_acceleration = settings.max_acceleration_px_s2 / 3.0
    # All pairs of a peak before and one after: (S, K, before, after).
    before = position_px[0][:, None, :, None]
    after = position_px[2][:, None, None, :]
    now = middle[:, :, None, None]
    apart = later - earlier
    left, right = later / apart, -earlier / apart
    misfit = now - left * before - right * after
    variance = (
        variance_px2[1][:, :, None, None]
        + left**2 * variance_px2[0][:, None, :, None]
        + right**2 * variance_px2[2][:, None, None, :]
        + (0.5 * sigma_acceleration * earlier * later) ** 2
    )
    rate = (after - before) / apart
    bend = misfit**2 / variance
    possible = (bend <= _GATE_SIGMA**2) & (np.abs(rate) <= settings.max_rate_px_s)
    sensors, peaks = middle.shape
    if possible.all() and peaks == 1:
        first = np.zeros(middle.shape, dtype=np.intp)
        return first, first, np.ones(middle.shape, dtype=np.bool_)
    cost = np.where(possible, bend + (rate / sigma_rate) ** 2, np.inf)
    flat = cost.reshape(sensors, peaks, -1)
    best = flat.argmin(axis=2)
    found = np.isfinite(np.take_along_axis(flat, best[:, :, None], 2)[:, :, 0])
    pair = np.unravel_index(best, (position_px.shape[2], position_px.shape[2]))
    chosen = [np.where(found, index, -1) for index in pair]
    # One peak is one marker's: those that others claim, too, are not known.
    for index in chosen:
        found &= ~_claimed_twice(index)
    for which, step in ((0, earlier), (1, later)):
        nearest = _nearest(position_px[2 * which], middle, abs(step) * settings.max_rate_px_s)
        chosen[which] = np.where(found, chosen[which], nearest).astype(np.intp)
    return chosen[0], chosen[1], found


def _nearest(other: Array, position: Array, distance_px: float) -> NDArray[np.intp]:
    """Return the one peak of another exposure that is near enough; -1: none or several, (S, K)."""
    with np.errstate(invalid="ignore"):
        near = np.abs(other[:, None, :] - position[:, :, None]) <= distance_px
    alone = (near.sum(axis=2) == 1) & (near.sum(axis=1)[np.arange(len(near))[:, None],
                                                        near.argmax(axis=2)] == 1)  # fmt: skip
    return np.where(alone, near.argmax(axis=2), -1)


def _claimed_twice(index: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which peaks chose one that another peak of their sensor chose, too, (S, K)."""
    same = index[:, :, None] == index[:, None, :]
    return np.asarray((same.sum(axis=2) > 1) & (index >= 0))
